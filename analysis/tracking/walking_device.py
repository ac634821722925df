"""AIR along the walk of a simulated device: whether a bundle that follows the image loses anything of it.

    python -m analysis.tracking.walking_device --bundle B.zip --json F
    python -m analysis.tracking.walking_device --bundle B.zip --set drift.shift_px=0.05 --pages 100 --json F

The device walks from page to page, and its pages are read in order as a service reads them. The mean AIR of the last
pages is compared with that of the first ones. A page that is not given out counts with no bits.
"""

from __future__ import annotations

import math
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean, median

import click
import numpy as np

from analysis.tracking.operating_points import LEVELS, WALKS_STREAM, Point
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.device.state import Device, load_device
from lightpage.errors import InvalidInputError
from lightpage.metrics.provenance import write_figures
from lightpage.progress import track
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.simulator.simulator import Simulator


@dataclass(frozen=True)
class ReadPage:
    """A page of the walk.

    Attributes:
        air: AIR, bits a symbol; zero for a page that was not given out.
        shift_px: true shift (x, y) since the device was calibrated, camera pixels.
        seen_px: shift that the tracker found; None for a page that was not given out.
        lost: name of the error of such a page.
        seconds: time of the decode.
    """

    air: float
    shift_px: tuple[float, float]
    seen_px: tuple[float, float] | None
    lost: str | None
    seconds: float


def read_along(point: Point, pages: int, seed: int) -> list[ReadPage]:
    """Read pages of a device that walks as its state says."""
    tracker = point.tracker.fork()
    simulator = Simulator(point.decoder.bundle.profile, point.device, LEVELS, seed)
    read = []
    for number in track(range(pages), point.name, unit="page"):
        symbols = point.symbols(WALKS_STREAM, seed, number)
        page = simulator.simulate(symbols)
        begun = time.perf_counter()
        air, seen = point.air(tracker, page.pair, symbols)
        x, y = map(float, page.shift_px)
        place = tuple(seen["shift_px"]) if "shift_px" in seen else None
        read.append(ReadPage(air, (x, y), place, seen.get("lost"), time.perf_counter() - begun))
    return read


@click.command()
@click.option("--bundle", required=True, type=click.Path(path_type=Path, exists=True), help="Bundle of the device.")
@click.option(
    "--device", "state", type=click.Path(path_type=Path), help="True state (TOML); the usual one if left out."
)
@click.option("--set", "settings", multiple=True, metavar="TABLE.KEY=VALUE", help="Number of the true state to change.")
@click.option("--pages", default=200, show_default=True, type=click.IntRange(2), help="Pages that are read.")
@click.option("--compared", default=50, show_default=True, type=click.IntRange(1), help="Pages of either end.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(0), help="Seed of pages, noise and walk.")
@click.option("--json", "json_path", type=OutputFile(), required=True)
def main(
    bundle: Path,
    state: Path | None,
    settings: tuple[str, ...],
    pages: int,
    compared: int,
    seed: int,
    json_path: Path,
) -> None:
    """Print the AIR of the last pages of a walk over that of the first ones.

    Raises:
        InvalidInputError: fewer pages than are compared.
    """
    if pages < compared:
        raise InvalidInputError("--pages", pages, f"at least {compared}, as are compared of either end")
    decoder = Decoder.load(bundle)
    device = Device() if state is None else load_device(state)
    device = device.of_profile(decoder.bundle.profile).with_settings([*settings])
    read = read_along(Point(bundle.name, decoder, device), pages, seed)
    first, last = (fmean(page.air for page in part) for part in (read[:compared], read[-compared:]))
    share = last / first if first > 0 else 0.0
    off = [np.subtract(page.seen_px, page.shift_px) for page in read if page.seen_px is not None]
    lost = sum(page.lost is not None for page in read)
    farthest_px = max(math.hypot(*page.shift_px) for page in read)
    seconds = median(page.seconds for page in read)
    figures = {
        "pages": pages,
        "compared": compared,
        "air_first": first,
        "air_last": last,
        "last_over_first": share,
        "lost": lost,
        "farthest_px": farthest_px,
        "position_error_px": float(np.std(off, axis=0).max()) if off else None,
        "seconds_per_page": seconds,
    }
    click.echo(
        f"AIR of the last {compared} pages {last:.4f}, of the first {compared} {first:.4f} bit a symbol: "
        f"{share:.4f}; {lost} of {pages} lost, walked up to {farthest_px:.2f} px; {1000 * seconds:.0f} ms a page"
    )
    asked = {"device": device.model_dump(mode="json"), "--pages": pages, "--compared": compared, "--seed": seed}
    kept = {"asked": asked, **figures, "read": [asdict(page) for page in read]}
    write_figures(json_path, kept, bundle=bundle, asked=asked)


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.tracking.walking_device"))
