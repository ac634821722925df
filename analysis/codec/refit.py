"""Gain of the blind refit of a page's smooth phase error, by level count, fitted terms and number of refits.

    python -m analysis.codec.refit --recording R.h5

Pages of a recording are decoded once; their phase errors are then put on new symbols of each level count.
"""

from __future__ import annotations

import sys

import click
import numpy as np
from numpy.typing import NDArray

from lightpage.cli.main import run
from lightpage.errors import InvalidInputError
from lightpage.metrics.information import achievable_rate
from lightpage.page.correction import ROUNDS, PhaseRefit
from lightpage.page.pilots import Pilots
from lightpage.page.symbols import symbol_phases
from lightpage.progress import track
from lightpage.recording.layout import narrow
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.coded_pages import AIR_LEVELS, phase_errors
from lightpage.runtime.archives.recordings.evaluation import was_seen
from lightpage.runtime.model.bundle.shipped import DEFAULT, bundle_path
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for

LEVELS = (32, 64, 128, 256)
Page = tuple[NDArray[np.float32], NDArray[np.float32]]


def pages_of(decoder: Decoder, recording: Recording) -> list[Page]:
    """Phase errors and concentrations of the pages that the bundle has not seen, [ny, nx] each."""
    tracker, mask, found = tracker_for(decoder), decoder.bundle.pilot_mask, []
    for index in track(range(recording.pages), "decode"):
        frames, symbols = recording.frames(index), recording.symbols(index)
        if symbols is None or was_seen(decoder, frames):
            continue
        pilots = Pilots.of_symbols(mask, symbols, recording.levels)
        page = tracker.decode(narrow(frames, recording.bit_depth), recording.levels, pilots)
        found.append((phase_errors(page, symbols, recording.levels), page.concentration))
    return found


def air(error: NDArray[np.floating], kappa: NDArray[np.floating], data: NDArray[np.bool_]) -> float:
    """AIR of a page's data symbols, bits."""
    zeros = np.zeros(int(data.sum()), np.int64)
    return float(achievable_rate(error[data], kappa[data], zeros, AIR_LEVELS).mean())


@click.command()
@click.option("--bundle", default=DEFAULT, show_default=True)
@click.option("--recording", required=True, type=click.Path(), help="Known pages that the bundle has not seen.")
def main(bundle: str, recording: str) -> None:
    """Print the AIR by level count, fitted form and rounds."""
    decoder = Decoder.load(bundle_path(bundle))
    with Recording.open(recording) as file:
        pages = pages_of(decoder, file)
    if not pages:
        raise InvalidInputError(f"recording {recording}", "no page that the bundle has not seen", "at least one")
    mask, shape = decoder.bundle.pilot_mask, decoder.bundle.profile.page_shape
    zones = decoder.phase_refit
    forms = {
        "plane": (PhaseRefit(shape), ROUNDS),
        "plane a zone": (zones, ROUNDS),
        f"the same, {3 * ROUNDS} rounds": (zones, 3 * ROUNDS),
        f"the same, {8 * ROUNDS} rounds": (zones, 8 * ROUNDS),
    }
    before = [air(error, kappa, ~mask) for error, kappa in pages]
    click.echo(f"{'levels':>6}  {'form':<24} {'AIR':>8} {'deviation':>10} {'worst':>8}")
    click.echo(f"{'any':>6}  {'none':<24} {np.mean(before):>8.4f} {np.std(before):>10.4f} {min(before):>8.4f}")
    for levels in LEVELS:
        rng = np.random.default_rng(levels)
        drawn = [rng.integers(0, levels, shape).astype(np.uint8) for _ in pages]
        for name, (refit, rounds) in forms.items():
            rates = []
            for (error, kappa), symbols in zip(pages, drawn, strict=True):
                pilots = Pilots.of_symbols(mask, symbols, levels)
                off = refit.error(symbol_phases(symbols, levels) + error, kappa, levels, pilots, rounds)
                rates.append(air(error - off, kappa, ~mask))
            click.echo(f"{levels:>6}  {name:<24} {np.mean(rates):>8.4f} {np.std(rates):>10.4f} {min(rates):>8.4f}")


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.codec.refit"))
