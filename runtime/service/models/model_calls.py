"""The models: ListModels, Rollback, RollForward, UploadModel, ActivateModel, PinModel."""

import asyncio
from collections.abc import AsyncIterator
from functools import partial

from lightpage.errors import MalformedError, StalledError
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.wire.messages import message_of
from lightpage.runtime.service.admission import Slots
from lightpage.runtime.service.caller import Call, Role
from lightpage.runtime.service.limits import Limits
from lightpage.runtime.service.models.models import ModelEntry, Models
from lightpage.runtime.service.models.uploads import Upload
from lightpage.runtime.service.rpc import rpc


class ModelCalls:
    """Handlers of the calls about models.

    Args:
        models: models of the service.
        limits: limits of uploads.
        uploads: the slot for one.
    """

    def __init__(self, models: Models, limits: Limits, uploads: Slots) -> None:
        self._models, self._limits, self._uploads = models, limits, uploads

    @rpc(Role.READ)
    def ListModels(self, request: pb.ListModelsRequest, call: Call) -> pb.ListModelsReply:
        """All models that are loaded, or those of the store too."""
        return pb.ListModelsReply(models=map(model_message, self._models.entries(request.stored)))

    @rpc(Role.ADMIN)
    def Rollback(self, request: pb.RollbackRequest, call: Call) -> pb.RollbackReply:
        """Go back to the model before."""
        current, before = self._models.rollback(request.expected_version, call.actor)
        return pb.RollbackReply(model_version=current.version, previous_version=before.version)

    @rpc(Role.ADMIN)
    def RollForward(self, request: pb.RollForwardRequest, call: Call) -> pb.RollForwardReply:
        """Go to the later model again."""
        current, before = self._models.roll_forward(request.expected_version, call.actor)
        return pb.RollForwardReply(model_version=current.version, previous_version=before.version)

    @rpc(Role.ADMIN)
    def ActivateModel(self, request: pb.ActivateModelRequest, call: Call) -> pb.ActivateModelReply:
        """Put a model in service."""
        current, before = self._models.activate(request.version, request.expected_version, call.actor)
        return pb.ActivateModelReply(model_version=current.version, previous_version=before.version)

    @rpc(Role.ADMIN)
    def PinModel(self, request: pb.PinModelRequest, call: Call) -> pb.PinModelReply:
        """Pin a model, or let go of it."""
        return pb.PinModelReply(model=model_message(self._models.pin(request.version, request.pinned, call.actor)))

    @rpc(Role.ADMIN, is_upload=True)
    async def UploadModel(self, requests: AsyncIterator[pb.UploadModelRequest], call: Call) -> pb.UploadModelReply:
        """Receive a bundle, check it, and keep it."""
        first = await anext(requests, None)
        if first is None or first.WhichOneof("part") != "header":
            raise MalformedError("first message of UploadModel", "no header", "a header, then chunks")
        header, limit_s = first.header, self._limits.model_s
        call.correlation_id = header.correlation_id or call.correlation_id
        call.caller.actor = call.actor
        with self._uploads.held_at_once():
            given = (header.bytes, header.sha256, header.signature)
            upload = Upload(self._models, self._limits.model_bytes, call.caller, *given)
            try:
                async with asyncio.timeout(limit_s):
                    await self._receive(upload, requests, call)
                entry = await call.in_thread(upload.finish)
            except TimeoutError:
                raise StalledError("uploaded model", f"not all of it within {limit_s:g} s", "a faster one") from None
            finally:
                upload.drop()
        return pb.UploadModelReply(model=model_message(entry))

    @staticmethod
    async def _receive(upload: Upload, requests: AsyncIterator[pb.UploadModelRequest], call: Call) -> None:
        await call.in_thread(upload.begin)
        async for message in requests:
            if message.WhichOneof("part") != "chunk":
                got = "a second header" if message.HasField("header") else "an empty message"
                raise MalformedError("message of UploadModel", got, "chunks from there on")
            await call.in_thread(partial(upload.add, message.chunk))


def model_message(entry: ModelEntry) -> pb.Model:
    """Return a model as its message; metrics that are no numbers stay behind."""
    metrics = {k: float(v) for k, v in entry.manifest.metrics.items() if isinstance(v, int | float)}
    return message_of(pb.Model, entry, entry.manifest, metrics=metrics)
