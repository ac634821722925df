"""Lightpage reads phase pages through a glass light-pipe, and calibrates itself to the device that it reads.

What most users need is here by name: `lightpage.Recording.open("r.h5")`, `lightpage.load("bench")`. Each name is
imported when it is first used.

The folders beside this file are the ground that everything else stands on: devices, pages, recordings, codes, waves,
calibration, metrics and a simulator, without torch and without a network. `train`, `export`, `runtime`, `report`,
`study`, `demo` and `virtual_device` are links to the folders at the top of the repository.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from pkgutil import extend_path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lightpage.device.profile import Profile, load_profile
    from lightpage.device.state import Device, load_device
    from lightpage.errors import LightpageError
    from lightpage.metrics.measures import PageMeasures, measure
    from lightpage.page.pilots import Pilots
    from lightpage.recording.frame_pair import FramePair
    from lightpage.recording.reader import Recording
    from lightpage.recording.writer import RecordingWriter
    from lightpage.runtime.archives.recordings.evaluation import Evaluation, evaluate
    from lightpage.runtime.client.client import LightpageClient
    from lightpage.runtime.client.wire.channel import TlsFiles
    from lightpage.runtime.model.bundle.bundle import Bundle
    from lightpage.runtime.model.decoding.decoder import Decoder
    from lightpage.runtime.model.decoding.following import FollowingDecoder
    from lightpage.runtime.model.decoding.image_tracker import tracker_for
    from lightpage.runtime.model.decoding.page import DecodedPage
    from lightpage.simulator.simulator import Simulator

# A caller's own stubs of `lightpage/v1/lightpage.proto`, made by plain protoc, lie in a folder `lightpage/v1` too.
__path__ = extend_path(__path__, __name__)

_HOMES = {
    "Bundle": "lightpage.runtime.model.bundle.bundle",
    "DecodedPage": "lightpage.runtime.model.decoding.page",
    "Decoder": "lightpage.runtime.model.decoding.decoder",
    "Device": "lightpage.device.state",
    "Evaluation": "lightpage.runtime.archives.recordings.evaluation",
    "FramePair": "lightpage.recording.frame_pair",
    "LightpageClient": "lightpage.runtime.client.client",
    "LightpageError": "lightpage.errors",
    "PageMeasures": "lightpage.metrics.measures",
    "Pilots": "lightpage.page.pilots",
    "Profile": "lightpage.device.profile",
    "Recording": "lightpage.recording.reader",
    "RecordingWriter": "lightpage.recording.writer",
    "Simulator": "lightpage.simulator.simulator",
    "TlsFiles": "lightpage.runtime.client.wire.channel",
    "evaluate": "lightpage.runtime.archives.recordings.evaluation",
    "load_device": "lightpage.device.state",
    "load_profile": "lightpage.device.profile",
    "measure": "lightpage.metrics.measures",
    "tracker_for": "lightpage.runtime.model.decoding.image_tracker",
}

__all__ = [
    "Bundle",
    "DecodedPage",
    "Decoder",
    "Device",
    "Evaluation",
    "FramePair",
    "LightpageClient",
    "LightpageError",
    "PageMeasures",
    "Pilots",
    "Profile",
    "Recording",
    "RecordingWriter",
    "Simulator",
    "TlsFiles",
    "evaluate",
    "load",
    "load_device",
    "load_profile",
    "measure",
    "tracker_for",
]


def load(
    name_or_path: str | Path,
    threads: int | None = None,
    provider: str = "cpu",
    engine_cache: str | Path | None = None,
    *,
    tracking: bool = True,
) -> FollowingDecoder:
    """Return a bundle's decoder: it follows the image from page to page, and raises where pilots contradict a page.

    Args:
        name_or_path: of a bundle, or the name of a shipped one.
        threads: of an inference; by default all cores.
        provider: what pages are computed with: ``cpu``, ``cuda``, ``tensorrt``, or ``cuda:1`` for the second GPU.
        engine_cache: folder where TensorRT keeps its engines; without, it builds them each time.
        tracking: whether the image is followed; else each page is decoded where calibration saw it.

    Raises:
        BundleError: there is none, or it is damaged.
        InvalidInputError: the text names no provider, or one that keeps no engines.
        ProviderError: there is no such provider here.
    """
    from lightpage.runtime.model.bundle.bundle import Bundle
    from lightpage.runtime.model.bundle.shipped import bundle_path
    from lightpage.runtime.model.decoding.following import FollowingDecoder
    from lightpage.runtime.model.execution.providers import Provider

    cache = None if engine_cache is None else Path(engine_cache)
    bundle = Bundle.open(bundle_path(str(name_or_path)))
    return FollowingDecoder(bundle, threads, Provider.parse(provider, cache), tracking=tracking)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)
