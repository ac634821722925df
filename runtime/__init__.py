"""No torch: bundles, decoding, frame sources, recalibration, the gRPC service and its client.

What most users need is here by name: `runtime.load("bench")`. Each name is imported when it is first used.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from runtime.bulk.evaluation import Evaluation, evaluate
    from runtime.bundle.bundle import Bundle
    from runtime.client.client import LightpageClient
    from runtime.decoding.decoder import Decoder
    from runtime.decoding.following import FollowingDecoder
    from runtime.decoding.image_tracker import tracker_for
    from runtime.decoding.page import DecodedPage
    from runtime.wire.tls import TlsFiles

_HOMES = {
    "Bundle": "runtime.bundle.bundle",
    "DecodedPage": "runtime.decoding.page",
    "Decoder": "runtime.decoding.decoder",
    "Evaluation": "runtime.bulk.evaluation",
    "LightpageClient": "runtime.client.client",
    "TlsFiles": "runtime.wire.tls",
    "evaluate": "runtime.bulk.evaluation",
    "tracker_for": "runtime.decoding.image_tracker",
}

__all__ = [
    "Bundle",
    "DecodedPage",
    "Decoder",
    "Evaluation",
    "LightpageClient",
    "TlsFiles",
    "evaluate",
    "load",
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
    """The decoder of a bundle: it follows the image from page to page, and raises where pilots contradict a page.

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
    from runtime.bundle.bundle import Bundle
    from runtime.bundle.shipped import bundle_path
    from runtime.decoding.following import FollowingDecoder
    from runtime.execution.providers import Provider

    cache = None if engine_cache is None else Path(engine_cache)
    bundle = Bundle.open(bundle_path(str(name_or_path)))
    return FollowingDecoder(bundle, threads, Provider.parse(provider, cache), tracking=tracking)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)
