"""The ground: devices, pages, recordings, waves, calibration, metrics and a simulator; no torch, no network.

What most users need is here by name: `lightpage.Recording.open("r.h5")`. Each name is imported when it is first used.
"""

from __future__ import annotations

from importlib import import_module
from pkgutil import extend_path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lightpage.device.profile import Profile, load_profile
    from lightpage.device.state import Device, load_device
    from lightpage.errors import LightpageError
    from lightpage.metrics.measures import PageMeasures, measure
    from lightpage.page.pilots import Pilots
    from lightpage.recording.frame_pair import FramePair
    from lightpage.recording.reader import Recording, RecordingWriter
    from lightpage.simulator.simulator import Simulator

# A caller's own stubs of `lightpage/v1/lightpage.proto`, made by plain protoc, lie in a folder `lightpage/v1` too.
__path__ = extend_path(__path__, __name__)

_HOMES = {
    "Device": "lightpage.device.state",
    "FramePair": "lightpage.recording.frame_pair",
    "LightpageError": "lightpage.errors",
    "PageMeasures": "lightpage.metrics.measures",
    "Pilots": "lightpage.page.pilots",
    "Profile": "lightpage.device.profile",
    "Recording": "lightpage.recording.reader",
    "RecordingWriter": "lightpage.recording.reader",
    "Simulator": "lightpage.simulator.simulator",
    "load_device": "lightpage.device.state",
    "load_profile": "lightpage.device.profile",
    "measure": "lightpage.metrics.measures",
}

__all__ = [
    "Device",
    "FramePair",
    "LightpageError",
    "PageMeasures",
    "Pilots",
    "Profile",
    "Recording",
    "RecordingWriter",
    "Simulator",
    "load_device",
    "load_profile",
    "measure",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)
