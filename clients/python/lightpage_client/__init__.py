"""A client of the Lightpage service: `LightpageClient("HOST:PORT")`. Its errors are of the classes in `errors`."""

from lightpage_client import errors
from lightpage_client.errors import LightpageError
from lightpage_client.recording.frame_pair import FramePair
from lightpage_client.runtime.client.answers import RemotePage
from lightpage_client.runtime.client.client import LightpageClient
from lightpage_client.runtime.client.outgoing import KnownPilots
from lightpage_client.runtime.client.wire.channel import TlsFiles

__all__ = ["FramePair", "KnownPilots", "LightpageClient", "LightpageError", "RemotePage", "TlsFiles", "errors"]


def __dir__() -> list[str]:
    return __all__
