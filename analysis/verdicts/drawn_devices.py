"""Devices of the whole capture range, calibrated on two known pages and read by their fitted waves alone.

    python -m analysis.verdicts.drawn_devices --devices 20 --json F
    python -m analysis.verdicts.drawn_devices --devices 20 --set sensor.full_well_e=32 --json F
    python -m analysis.verdicts.drawn_devices --devices 5 --foreign 0.33 --json F

A device is drawn by each seed, as `analysis.calibration.devices` does, calibrated and exported. Further pages are read
by the bundle's number of steps. Their AIR is compared with the bound of the light and, on pages that the export did not
read, with the AIR of the verdict. Devices of the other simulator, `--foreign`, have a share of its faults and no bound.
An interrupted run continues: seeds in the JSON file are not computed again.
"""

from __future__ import annotations

import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path

import click
import numpy as np

from analysis.calibration.devices import load
from analysis.comparison.data_set import CALIBRATED, bundle_by_waves
from analysis.foreign_device import ForeignDevice
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.device.profile import Profile, load_profile
from lightpage.device.state import Device, draw_device
from lightpage.errors import InvalidInputError, LightpageError
from lightpage.metrics.provenance import write_figures
from lightpage.progress import track
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.evaluation import evaluate
from lightpage.runtime.archives.recordings.reading import MOST_READ
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.simulator.light_bound import mean_information, sampled_concentrations

LEVELS = 256
BOUND_PAGES = 2
BOUND_SYMBOLS = 100
"""Symbols of a page whose bound is sampled: its standard error is some 0.02 bit with two pages."""


@dataclass(frozen=True)
class Row:
    """Figures of one device. All but the seed are None where it was not calibrated or not read.

    Attributes:
        seed: seed of the device.
        bound_bits: bound of the light, bits a symbol.
        air_bits: AIR of all pages that the fit has not seen, bits a symbol.
        over_bound: AIR over the bound.
        over_claim_bits: claimed information minus the AIR, bits a symbol.
        ece: expected calibration error of the confidences.
        verdict: verdict on the calibration.
        verdict_bits: AIR of the pages behind the verdict.
        verdict_error_bits: that AIR minus the AIR of pages that the export did not read.
        light_bits: information of the light as the calibration states it.
        user_bytes: user bytes of a page by the code of two to six pages.
        causes: names of the causes of what is lost with their bits, the largest first.
        seconds: time from the two known pages to the bundle.
        failure: error that ended calibration, export or reading.
    """

    seed: int
    bound_bits: float | None = None
    air_bits: float | None = None
    over_bound: float | None = None
    over_claim_bits: float | None = None
    ece: float | None = None
    verdict: str | None = None
    verdict_bits: float | None = None
    verdict_error_bits: float | None = None
    light_bits: float | None = None
    user_bytes: int | None = None
    causes: dict[str, float] | None = None
    seconds: float | None = None
    failure: str | None = None


_COLUMNS = ("bound", "AIR", "ratio", "claim", "ECE", "verdict", "error", "seconds")


def _line(row: Row) -> str:
    if row.failure is not None:
        return f"{row.seed:>6} {row.failure}"
    values = (row.bound_bits, row.air_bits, row.over_bound, row.over_claim_bits, row.ece)
    numbers = " ".join(f"{'-':>8}" if value is None else f"{value:>8.4f}" for value in values)
    cause = next(iter(row.causes), "") if row.causes else ""
    return f"{row.seed:>6} {numbers} {row.verdict:>8} {row.verdict_error_bits:>+8.3f} {row.seconds:>8.0f} {cause}"


def read_device(profile: Profile, device: Device | ForeignDevice, seed: int, pages: int, folder: Path) -> Row:
    """Calibrate and read a device; `pages` are read beyond those of the verdict."""
    pages += MOST_READ
    if isinstance(device, ForeignDevice):
        device.write(folder / "recording.h5", CALIBRATED + pages, LEVELS, seed)
    start = time.perf_counter()
    own = device if isinstance(device, Device) else Device()  # the recording is there already
    recording, bundle = bundle_by_waves(folder, profile, own, pages, seed)
    seconds = time.perf_counter() - start
    decoder = Decoder.load(bundle)
    with Recording.open(recording) as file:
        evaluation = evaluate(decoder, file, tracker_for(decoder))
    figures = evaluation.figures
    calibration = decoder.bundle.calibration
    goodness, reading = calibration.goodness, calibration.reading
    assert goodness is not None
    assert reading is not None  # the recording has pages that the fit has not seen
    bound = _bound_bits(profile, device, seed) if isinstance(device, Device) else None
    return Row(
        seed=seed,
        bound_bits=bound,
        air_bits=figures.air_bits_per_symbol,
        over_bound=bound and figures.air_bits_per_symbol / bound,
        over_claim_bits=figures.over_claim_bits_per_symbol,
        ece=figures.ece,
        verdict=goodness.verdict,
        verdict_bits=reading.air_bits,
        verdict_error_bits=reading.air_bits - float(np.mean(evaluation.air_per_page[MOST_READ:])),
        light_bits=reading.light_bits,
        user_bytes=reading.user_bytes,
        causes={cause.name: cause.bits for cause in goodness.causes},
        seconds=seconds,
    )


def _bound_bits(profile: Profile, device: Device, seed: int) -> float:
    """Bound of a device's light, bits a symbol."""
    sampled = (
        sampled_concentrations(profile, device, LEVELS, BOUND_SYMBOLS, (seed, page)) for page in range(BOUND_PAGES)
    )
    bits, _ = mean_information([*chain.from_iterable(sampled)], LEVELS, seed)
    return bits


@click.command()
@click.option("--profile", "profile_name", default="bench", show_default=True, help="Shipped profile or TOML file.")
@click.option("--devices", default=20, show_default=True, type=click.IntRange(1))
@click.option("--first-seed", default=1000, show_default=True, type=click.IntRange(0))
@click.option("--set", "changes", multiple=True, metavar="TABLE.KEY=VALUE", help="Number of the true state to change.")
@click.option("--foreign", "faults", type=click.FloatRange(0), help="Devices of the other simulator; share of faults.")
@click.option("--pages", default=4, show_default=True, type=click.IntRange(1), help="Pages beyond the verdict's.")
@click.option("--json", "json_path", required=True, type=OutputFile())
def main(
    profile_name: str,
    devices: int,
    first_seed: int,
    changes: tuple[str, ...],
    faults: float | None,
    pages: int,
    json_path: Path,
) -> None:
    """Print the AIR of each device, its share of the bound, and its verdict."""
    profile = load_profile(profile_name)
    settings: dict[str, object] = {"profile": profile.to_toml(), "set": [*changes], "foreign": faults, "pages": pages}
    rows = {seed: row for seed, row in load(json_path, settings, Row).items() if row.failure is None}
    click.echo(f"{'seed':>6} " + " ".join(f"{column:>8}" for column in _COLUMNS))
    for seed in track(range(first_seed, first_seed + devices), "devices", unit="device"):
        if seed not in rows:
            device: Device | ForeignDevice
            if faults is not None:
                device = ForeignDevice.draw(seed).with_faults(faults)
            else:
                device = draw_device(np.random.default_rng(seed)).of_profile(profile).with_settings([*changes])
            with tempfile.TemporaryDirectory() as folder:
                try:
                    rows[seed] = read_device(profile, device, seed, pages, Path(folder))
                except InvalidInputError:
                    raise
                except LightpageError as error:
                    rows[seed] = Row(seed, failure=str(error))
            outcomes = [asdict(rows[one]) for one in sorted(rows)]
            write_figures(json_path, {"settings": settings, "outcomes": outcomes}, asked=settings)
        click.echo(_line(rows[seed]))
    shares = np.array([row.over_bound or 0.0 for row in rows.values()])
    errors = np.array([np.inf if row.failure else abs(row.verdict_error_bits or 0.0) for row in rows.values()])
    click.echo(f"{np.count_nonzero(shares >= 0.97)} of {len(rows)} read at least 0.97 of their bound")
    click.echo(f"{np.count_nonzero(errors <= 0.1)} of {len(rows)} verdicts within 0.1 bit of pages read afterwards")


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.verdicts.drawn_devices"))
