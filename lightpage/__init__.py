"""Lightpage reads phase pages through a glass light-pipe, and calibrates itself to the device that it reads.

What most users need is here by name: `lightpage.Recording.open("r.h5")`, `lightpage.load("bench")`. Each name is
imported when it is first used.

The folders beside this file are the ground that everything else stands on: devices, pages, recordings, codes, waves,
calibration, metrics and a simulator, without torch and without a network. `train`, `export`, `runtime`, `report`,
`study`, `demo` and `virtual_device` are links to the folders at the top of the repository.
"""

from __future__ import annotations

from importlib import import_module
from pkgutil import extend_path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lightpage.calibration.document import Calibration, load_calibration
    from lightpage.device.profile import Profile, load_profile
    from lightpage.device.state import Device, load_device
    from lightpage.errors import LightpageError
    from lightpage.metrics.measures import PageMeasures, measure
    from lightpage.page.pilots import Pilots
    from lightpage.recording.frame_pair import FramePair
    from lightpage.recording.reader import Recording
    from lightpage.recording.writer import RecordingWriter
    from lightpage.report.plots import plot
    from lightpage.runtime.archives.recordings.decoding import decode_recording
    from lightpage.runtime.archives.recordings.evaluation import Evaluation, evaluate
    from lightpage.runtime.archives.recordings.refused import RefusedPage
    from lightpage.runtime.client.client import LightpageClient
    from lightpage.runtime.client.wire.channel import TlsFiles
    from lightpage.runtime.model.bundle.bundle import Bundle
    from lightpage.runtime.model.decoding.decoder import Decoder
    from lightpage.runtime.model.decoding.following import FollowingDecoder, load
    from lightpage.runtime.model.decoding.image_tracker import tracker_for
    from lightpage.runtime.model.decoding.page import DecodedPage
    from lightpage.simulator.simulator import Simulator

    __version__: str

# A caller's own stubs of `lightpage/v1/lightpage.proto`, made by plain protoc, lie in a folder `lightpage/v1` too.
__path__ = extend_path(__path__, __name__)

_HOMES = {
    "Bundle": "lightpage.runtime.model.bundle.bundle",
    "Calibration": "lightpage.calibration.document",
    "DecodedPage": "lightpage.runtime.model.decoding.page",
    "Decoder": "lightpage.runtime.model.decoding.decoder",
    "Device": "lightpage.device.state",
    "Evaluation": "lightpage.runtime.archives.recordings.evaluation",
    "FollowingDecoder": "lightpage.runtime.model.decoding.following",
    "FramePair": "lightpage.recording.frame_pair",
    "LightpageClient": "lightpage.runtime.client.client",
    "LightpageError": "lightpage.errors",
    "PageMeasures": "lightpage.metrics.measures",
    "Pilots": "lightpage.page.pilots",
    "Profile": "lightpage.device.profile",
    "Recording": "lightpage.recording.reader",
    "RecordingWriter": "lightpage.recording.writer",
    "RefusedPage": "lightpage.runtime.archives.recordings.refused",
    "Simulator": "lightpage.simulator.simulator",
    "TlsFiles": "lightpage.runtime.client.wire.channel",
    "decode_recording": "lightpage.runtime.archives.recordings.decoding",
    "evaluate": "lightpage.runtime.archives.recordings.evaluation",
    "load": "lightpage.runtime.model.decoding.following",
    "load_calibration": "lightpage.calibration.document",
    "load_device": "lightpage.device.state",
    "load_profile": "lightpage.device.profile",
    "measure": "lightpage.metrics.measures",
    "plot": "lightpage.report.plots",
    "tracker_for": "lightpage.runtime.model.decoding.image_tracker",
}

__all__ = [
    "Bundle",
    "Calibration",
    "DecodedPage",
    "Decoder",
    "Device",
    "Evaluation",
    "FollowingDecoder",
    "FramePair",
    "LightpageClient",
    "LightpageError",
    "PageMeasures",
    "Pilots",
    "Profile",
    "Recording",
    "RecordingWriter",
    "RefusedPage",
    "Simulator",
    "TlsFiles",
    "__version__",
    "decode_recording",
    "evaluate",
    "load",
    "load_calibration",
    "load_device",
    "load_profile",
    "measure",
    "plot",
    "tracker_for",
]


def __dir__() -> list[str]:
    return __all__


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("lightpage")
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)
