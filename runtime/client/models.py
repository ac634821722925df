"""The models of a service: which there are, and which of them decodes."""

import hashlib
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from warnings import warn

from lightpage.errors import InvalidInputError
from lightpage.runtime.client.answers import ModelInfo
from lightpage.runtime.client.connection import DATA_S, SubClient
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.wire.messages import CHUNK_BYTES, answer_of
from lightpage.runtime.model.bundle.signature_file import read_signature


class ModelsClient(SubClient):
    """Lists the models of the service, adds to them, and changes which of them decodes::

        version = client.models.upload("mine.zip").version
        current, before = client.models.activate(version)
        client.models.roll_back(expected_version=current)  # repeated with it, it steps back once

    What changes the model in service takes the version that must be in service until then, empty for any, and raises
    `OtherModelError` where another one is.
    """

    def list(self, stored: bool = False) -> Sequence[ModelInfo]:
        """Return all models that the service holds loaded, the oldest first; before them those that only its store has.

        Args:
            stored: whether to name the latter too.

        Raises:
            LightpageError: no answer.
        """
        reply: pb.ListModelsReply = self._ask("ListModels", stored=stored)
        return [answer_of(ModelInfo, model) for model in reply.models]

    def __call__(self) -> Sequence[ModelInfo]:
        """Return `list()`, as the method `models` of version 0.1.0 did."""
        warn("LightpageClient.models() is LightpageClient.models.list() now", DeprecationWarning, stacklevel=2)
        return self.list()

    def upload(self, path: str | Path, timeout_s: float = DATA_S) -> ModelInfo:
        """Give the service a bundle, a zip file, to be kept in its store and not put in service; return its model.

        A signature beside it, in a file with `.sig` behind its name, goes along.

        Raises:
            InvalidInputError: no file that can be read.
            ModelExistsError: the service has a model of its version.
            BundleError: it is damaged, or for another device, or its signature is no good.
            StoreError: the service has no store, or one that cannot be written.
            LimitError: it is too large.
        """
        path = Path(path)
        try:
            with path.open("rb") as file:
                header = pb.UploadModelHeader(
                    bytes=os.fstat(file.fileno()).st_size,
                    sha256=hashlib.file_digest(file, "sha256").digest(),
                    signature=read_signature(path),
                )
                file.seek(0)

                def parts() -> Iterator[pb.UploadModelRequest]:
                    yield pb.UploadModelRequest(header=header)
                    while chunk := file.read(CHUNK_BYTES):
                        yield pb.UploadModelRequest(chunk=chunk)

                reply: pb.UploadModelReply = self._ask("UploadModel", parts(), timeout_s)
        except OSError as error:
            raise InvalidInputError(f"bundle {path}", error, "a zip file that can be read") from None
        return answer_of(ModelInfo, reply.model)

    def activate(self, version: str, expected_version: str = "") -> tuple[str, str]:
        """Put a model in service that the service has; return the versions (now current, before).

        Raises:
            OtherModelError: another one is in service than was expected.
            BundleError: there is none, it is damaged, or the change cannot be noted; then nothing changes.
        """
        return _changed(self._ask("ActivateModel", version=version, expected_version=expected_version))

    def roll_back(self, expected_version: str = "") -> tuple[str, str]:
        """Go back to the model before; return the versions (now current, before).

        Raises:
            OtherModelError: another one is in service than was expected.
            BundleError: there is none, or the change cannot be noted in the service's store; then nothing changes.
        """
        return _changed(self._ask("Rollback", expected_version=expected_version))

    def roll_forward(self, expected_version: str = "") -> tuple[str, str]:
        """Go to the later model again, after a roll-back; else as `roll_back`."""
        return _changed(self._ask("RollForward", expected_version=expected_version))

    def pin(self, version: str, pinned: bool = True) -> ModelInfo:
        """See that a model is never deleted, nor replaced by the service itself, or let go of it; return it.

        Raises:
            BundleError: there is none, or it cannot be noted.
        """
        return answer_of(ModelInfo, self._ask("PinModel", version=version, pinned=pinned).model)


def _changed(reply: pb.ActivateModelReply | pb.RollbackReply | pb.RollForwardReply) -> tuple[str, str]:
    return reply.model_version, reply.previous_version
