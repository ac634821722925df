"""The models: ListModels, Rollback."""

from __future__ import annotations

from runtime.pb.lightpage.v1 import lightpage_pb2 as pb
from runtime.rpc.call import Call
from runtime.rpc.replies import model_message
from runtime.service.dataplane import DataPlane


class ModelCalls:
    """Handlers of the calls about models.

    Args:
        plane: has the models.
    """

    def __init__(self, plane: DataPlane) -> None:
        self._plane = plane

    def Rollback(self, request: pb.RollbackRequest, call: Call) -> pb.RollbackReply:
        """Go back to the model before."""
        current, dropped = self._plane.rollback(actor=call.actor)
        return pb.RollbackReply(model_version=current.version, previous_version=dropped.version)

    def ListModels(self, request: pb.ListModelsRequest, call: Call) -> pb.ListModelsReply:
        """All models that are held."""
        models = self._plane.registry.models
        return pb.ListModelsReply(models=[model_message(model, model is models[-1]) for model in models])
