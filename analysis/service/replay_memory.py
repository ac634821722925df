"""Memory that the service keeps of lost pages with request ids: bytes a page, as the interpreter counts them.

    python -m analysis.service.replay_memory --json FILE

Every page is photographed and decoded as the bench device's are, and believed by nobody. Each call of ReadPage has an
id of its own, so that its answer is kept for a caller who asks again.
"""

from __future__ import annotations

import gc
import sys
import tracemalloc
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import click
import numpy as np

from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.errors import Reason, UnconfirmedPageError
from lightpage.metrics.provenance import write_figures
from lightpage.page.pilots import Pilots
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.device.acquisition.source import SHOT_S, FrameSource, Shot
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.bundle.shipped import DEFAULT, bundle_path
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.page import DecodedPage, StepLimit
from lightpage.runtime.model.decoding.tracking import NoTracker
from lightpage.runtime.model.decoding.turns import Turn
from lightpage.runtime.service.caller import Call, Caller
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.models.loader import Loader
from lightpage.runtime.service.models.models import Models
from lightpage.runtime.service.monitoring.monitor import Monitor
from lightpage.runtime.service.pages.page_calls import PageCalls

PAGES = 1000


class _Disbelief(NoTracker):
    """Loses every page, with all that is known of it. One page is decoded; its arrays are copied for the others."""

    def __init__(self, decoder: Decoder, pair: FramePair) -> None:
        super().__init__(decoder)
        self._page = decoder.decode(pair)

    def decode(
        self,
        pair: FramePair,
        levels: int,
        pilots: Pilots | None = None,
        turn: Turn | None = None,
        limit: StepLimit | None = None,
    ) -> DecodedPage:
        """See `Tracker`."""
        copies = {name: getattr(self._page, name).copy() for name in ("symbols", "phase", "concentration")}
        lost = UnconfirmedPageError("pilots", "0.02 of 6.59 claimed bits", "more", Reason.PILOTS_DISAGREE)
        raise lost.of(replace(self._page, **copies))


class _Photographs(FrameSource):
    """New frames for each page."""

    name, levels = "bench", 256

    def __init__(self, bundle: Bundle, pair: FramePair) -> None:
        self._pair, self._taken = pair, 0
        self.bit_depth, self.frame_shape = bundle.manifest.camera_bit_depth, bundle.profile.frame_shape

    def shot(self, timeout_s: float = SHOT_S, page: int | None = None) -> Shot:
        """See `FrameSource`."""
        self._taken += 1
        return Shot(FramePair(self._pair.in_phase.copy(), self._pair.quadrature.copy()), self._taken)


def measured(pages: int = PAGES) -> dict[str, float]:
    """Lose so many pages, each with a request id.

    Returns:
        `frame_pair_bytes` of one page; `held_bytes` by the interpreter's count, and `counted_bytes` by the service's,
        both for one lost page.
    """
    decoder = Decoder(Bundle.open(bundle_path(DEFAULT)))
    golden, kind = decoder.bundle.golden, decoder.bundle.manifest.frame_dtype
    pair = FramePair(*(np.ascontiguousarray(frame, kind) for frame in (golden.pair.in_phase, golden.pair.quadrature)))
    models = Models(decoder, loader=Loader(lambda one: _Disbelief(one, pair)))
    plane = DataPlane(models, _Photographs(decoder.bundle, pair), monitor=Monitor())
    calls = PageCalls(plane)

    def lose(number: int, pool: ThreadPoolExecutor) -> None:
        with suppress(UnconfirmedPageError):
            calls.ReadPage(pb.ReadPageRequest(request_id=f"controller-1/{number}"), Call("ReadPage", Caller(), pool))

    with ThreadPoolExecutor(1) as pool:
        lose(-1, pool)  # what is made once does not count
        gc.collect()
        tracemalloc.start()
        try:
            before, counted = tracemalloc.get_traced_memory()[0], calls.replays.held_bytes
            for number in range(pages):
                lose(number, pool)
            gc.collect()
            held = tracemalloc.get_traced_memory()[0] - before
        finally:
            tracemalloc.stop()
    return {
        "pages": pages,
        "frame_pair_bytes": pair.in_phase.nbytes + pair.quadrature.nbytes,
        "held_bytes": held / pages,
        "counted_bytes": (calls.replays.held_bytes - counted) / pages,
    }


@click.command()
@click.option("--pages", default=PAGES, show_default=True, type=click.IntRange(1), help="Pages to lose.")
@click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file.")
def main(pages: int, json_path: Path | None) -> None:
    """Print the bytes that are held for a lost page with a request id."""
    found = measured(pages)
    click.echo(
        f"{found['held_bytes']:.0f} bytes held for each of {pages} lost pages with a request id, "
        f"{found['counted_bytes']:.0f} counted; its frame pair has {found['frame_pair_bytes']:.0f}"
    )
    if json_path is not None:
        write_figures(json_path, found)


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.service.replay_memory"))
