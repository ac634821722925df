"""Gain of a flat field by the number of pages that it is made of, on the pages that follow them.

    python -m analysis.verdicts.flat_field --bundle B.zip --recording R.h5 --json F

`B.zip` is a bundle of a calibration, and `R.h5` a recording of its device with known symbols.
"""

from __future__ import annotations

import sys
from pathlib import Path

import click
import numpy as np

from lightpage.calibration.likelihood.flat_field import flat_field
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.errors import BundleError, RecordingError
from lightpage.metrics.provenance import write_figures
from lightpage.progress import track
from lightpage.recording.reader import Recording
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.execution.estimator_graph import EstimatorGraph
from lightpage.runtime.recalibration.flat_field import errors_of_pages
from lightpage.runtime.recalibration.noise import PhaseErrors

COUNTS = (0, 2, 4, 8, 16)
_LEAST_JUDGES = 4


@click.command()
@click.option("--bundle", "bundle_path", required=True, type=click.Path(path_type=Path))
@click.option("--recording", "recording_path", required=True, type=click.Path(path_type=Path))
@click.option("--json", "json_path", required=True, type=OutputFile())
def main(bundle_path: Path, recording_path: Path, json_path: Path) -> None:
    """Print the information of pages by the number of pages that their flat field is made of."""
    decoder = Decoder.load(bundle_path)
    graph = decoder.graph
    if not isinstance(graph, EstimatorGraph):
        raise BundleError(decoder.bundle.subject, "a network", "a bundle of a calibration (fitted waves)")
    mask = decoder.bundle.pilot_mask
    with Recording.open(recording_path) as recording:
        device = decoder.bundle.calibration.device(decoder.bundle.profile, recording.references())
        pages = range(recording.pages)
        pages_read = errors_of_pages(graph, recording, device, pages, mask)
        by_page = [errors for _, errors in track(pages_read, "pages", total=len(pages))]
    judges = len(by_page) - max(COUNTS)
    if judges < _LEAST_JUDGES:
        wanted = f"at least {max(COUNTS) + _LEAST_JUDGES} of different symbols"
        raise RecordingError(f"recording {recording_path}", f"{len(by_page)} pages that are read", wanted)
    judged = PhaseErrors.together(by_page[max(COUNTS) :])
    rows = []
    for count in COUNTS:
        flat = np.zeros(mask.shape)
        if count:
            made_of = PhaseErrors.together(by_page[:count])
            noise = made_of.noise(np.zeros_like(made_of.phases), ~mask)
            flat = flat_field(made_of.phases, np.mean(noise[0] / made_of.information + noise[1], axis=0)).phases
        bits = judged.bits(judged.noise(np.broadcast_to(flat, judged.phases.shape), ~mask), ~mask)
        rows.append({"pages": count, "rms_rad": float(flat.std()), "bits": bits})
        click.echo(f"{count:>2} pages: {flat.std():.4f} rad repeat, {bits:.3f} bits a symbol on {judges} other pages")
    write_figures(json_path, {"rows": rows})


if __name__ == "__main__":
    sys.exit(run(main))
