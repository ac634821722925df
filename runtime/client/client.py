"""A Python client of the service; its errors are of the same classes that the service raised."""

from operator import attrgetter
from typing import TYPE_CHECKING, Any, Self
from warnings import warn

from lightpage.clock import SYSTEM, Clock
from lightpage.runtime.client.answers import Description
from lightpage.runtime.client.connection import Connection
from lightpage.runtime.client.display import DisplayClient
from lightpage.runtime.client.frames import FramesClient
from lightpage.runtime.client.jobs import JobsClient
from lightpage.runtime.client.models import ModelsClient
from lightpage.runtime.client.pages import PagesClient
from lightpage.runtime.client.wire.channel import TlsFiles
from lightpage.words import brief

CALL_S = 60.0
"""Deadline of a call where none is given."""

_RENAMED = {
    "decode": "frames.decode",
    "read_page": "pages.read",
    "recalibrate": "jobs.recalibrate",
    "rollback": "models.roll_back",
}
"""Methods of version 0.1.0, and where they are now. They work for one release more."""


class LightpageClient:
    """Talks to the service at `target` (HOST:PORT). Use it in a `with` statement, or `close` it.

    Every method raises the `LightpageError` that the service raised, or one that says why there was no answer. What may
    be asked is told by `help(client.frames)`, and so on::

        with LightpageClient("127.0.0.1:50051") as client:
            print(client.describe().model.version)
            page = client.frames.decode(pair)

    Args:
        target: where the service is.
        timeout_s: deadline of a call.
        tls: certificates to connect with; None for a service without TLS.
        clock: clock by which a watch of a job ends, and waits for a service that is away.

    Attributes:
        target: as given.
        frames: decodes frames that the caller has.
        pages: has the service read pages from its own source.
        display: shows pages for the source, where the caller works its modulator.
        jobs: recalibrates.
        models: lists, adds and changes the models.

    Raises:
        InvalidInputError: no address, or certificates that are no good.
    """

    def __init__(
        self, target: str, timeout_s: float = CALL_S, tls: TlsFiles | None = None, clock: Clock = SYSTEM
    ) -> None:
        self.target = target
        self._connection = Connection(target, timeout_s, tls, clock)
        self.frames = FramesClient(self._connection)
        self.pages = PagesClient(self._connection)
        self.display = DisplayClient(self._connection)
        self.jobs = JobsClient(self._connection)
        self.models = ModelsClient(self._connection)

    def __repr__(self) -> str:
        return brief(self, self.target)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End all calls and close the connection."""
        self._connection.close()

    def describe(self) -> Description:
        """Return what the service is now.

        Raises:
            LightpageError: no answer.
        """
        return self._connection.describe()

    if not TYPE_CHECKING:  # a type checker knows the present names alone

        def __getattr__(self, name: str) -> Any:
            if name not in _RENAMED:
                raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
            warn(f"LightpageClient.{name} is LightpageClient.{_RENAMED[name]} now", DeprecationWarning, stacklevel=2)
            return attrgetter(_RENAMED[name])(self)
