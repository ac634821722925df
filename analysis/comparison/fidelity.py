"""What a second pass reads and takes, by how exactly it follows light: weights stay, waves and precision change.

    python -m analysis.comparison.fidelity --kept analysis/weights/bench/-0.6deg-32e-4px --out runs/fidelity

New pages of the data set's device are simulated, and every form decodes them. The times are of decodes in turns.
`float16` is what `lightpage export --precision float16` makes, each number rounded as a GPU would round it; its time on
a CPU says nothing, and none is given.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray

from analysis.comparison.kept_bundle import LEVELS, data_set_of, export_kept
from analysis.speed.speed import opened, seconds_of
from export.graph import FRAME_INPUTS, DecoderGraph, table_tensors
from export.half import deviation, rounded
from export.onnx_files import decoder_onnx
from lightpage.calibration.sampling_table import sampling_table
from lightpage.cli.main import run as run_command
from lightpage.cli.paths import OutputFolder
from lightpage.files import write_json
from lightpage.metrics.information import achievable_rate
from lightpage.page.symbols import pilot_mask, symbol_phases
from lightpage.progress import track
from lightpage.recording.reader import Recording
from lightpage.simulator.recording_job import RecordingJob
from runtime.decoding.decoder import PAGE_INPUTS
from runtime.execution.cpus import available_cpus
from runtime.execution.session import open_session
from train.fitting.validation import without_piston
from train.models.decoder import SymbolDecoder
from train.models.prediction import Prediction
from train.models.twin import RayTwin, TorchTwin
from train.models.waves import EXACT, ROUGH, Fidelity
from train.runs import Run, load_decoder, load_run

HALF = "float16"
_SEED = 70_000
FORMS: tuple[tuple[Fidelity, Fidelity], ...] = (
    (Fidelity(0.06, 0.05), Fidelity(0.2, 0.2)),
    (Fidelity(0.03, 0.03), Fidelity(0.1, 0.1)),
    (Fidelity(0.02, 0.015), ROUGH),
    (EXACT, ROUGH),
    (EXACT, Fidelity(0.03, 0.03)),
    (Fidelity(0.007, 0.007), Fidelity(0.02, 0.02)),
)
"""Errors of pipe and lenses to the cameras, and back."""


@dataclass(frozen=True)
class Form:
    """A form of the decoder.

    Attributes:
        name: for people.
        air: on the pages, bits a symbol.
        seconds: median of a page; NaN where it would say nothing.
        deviation: of p from that of the usual form in float32, over its length, 99th percentile of all symbols.
    """

    name: str
    air: float
    seconds: float
    deviation: float


def name_of(form: tuple[Fidelity, Fidelity]) -> str:
    """Pipe and lenses to the cameras, and back."""
    return "; ".join(f"{pipe:g}, {lenses:g}" for pipe, lenses in form)


def graphs(folder: Path) -> tuple[dict[str, bytes], bytes]:
    """Every form of a run's decoder as ONNX by name, and the usual one rounded.

    Args:
        folder: of a run of two passes.
    """
    run = load_run(folder)
    profile, calibration = run.profile, run.calibration
    with Recording.open(folder / "recording.h5") as recording:
        references = recording.references()
    table = sampling_table(TorchTwin(RayTwin(profile)), calibration.vector, calibration.turn_rad, profile)
    made = {}
    for form in track(FORMS, "export", unit="form"):
        graph = DecoderGraph(profile, _with(run, folder, form), run.kappa_scale).eval()
        made[name_of(form)] = decoder_onnx(graph, "uint8", profile.frame_shape, table_tensors(graph, table, references))
    return made, rounded(made[name_of((EXACT, ROUGH))], PAGE_INPUTS)


def _with(run: Run, folder: Path, form: tuple[Fidelity, Fidelity]) -> SymbolDecoder:
    """The run's decoder, its second pass of this form."""
    decoder = load_decoder(folder, run)
    usual = decoder.prediction
    assert usual is not None
    decoder.prediction = Prediction(run.profile, run.calibration.vector, decoder.choices.grid(run.profile), *form)
    decoder.prediction.illumination.copy_(usual.illumination)
    decoder.prediction.floor.copy_(usual.floor)
    return decoder


def measured(
    models: Mapping[str, bytes], half: bytes, recording: Recording, mask: NDArray[np.bool_], repeats: int, usual: str
) -> list[Form]:
    """Rates, times and deviations of all forms on the pages of a recording, whose pilots lie at `mask`; 256 levels."""
    sessions = {name: opened(model, available_cpus()) for name, model in models.items()}
    rounding = open_session(half, HALF, available_cpus(), once=True)
    rates: dict[str, list[float]] = {name: [] for name in (*models, HALF)}
    answers: dict[str, list[np.ndarray]] = {name: [] for name in rates}
    taken: dict[str, list[float]] = {name: [] for name in models}
    for page in track(range(recording.pages), "decode"):
        pair, symbols = recording.frames(page), recording.symbols(page)
        assert symbols is not None
        truth = symbol_phases(symbols, LEVELS).astype(np.float32)
        feeds = dict(zip(FRAME_INPUTS, (pair.in_phase, pair.quadrature), strict=True))
        for name in rates:
            p = (rounding if name == HALF else sessions[name]).run(["p"], feeds)[0]
            answers[name].append(p)
            at_rest = without_piston(p, truth, mask)[:, ~mask]
            kappa = np.linalg.norm(at_rest, axis=0)
            rate = achievable_rate(np.arctan2(at_rest[1], at_rest[0]), kappa, symbols[~mask], LEVELS)
            rates[name].append(float(rate.mean()))
    for _ in track(range(repeats), "time", unit="round"):
        for name, session in sessions.items():
            taken[name].append(seconds_of(session, feeds))
    whole = {name: np.concatenate(found, axis=1) for name, found in answers.items()}
    return [
        Form(
            name,
            float(np.mean(rates[name])),
            float(np.median(taken[name])) if taken.get(name) else float("nan"),
            deviation(whole[usual], whole[name]),
        )
        for name in rates
    ]


@click.command()
@click.option("--kept", required=True, type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--pages", default=8, show_default=True, type=click.IntRange(1, 1000), help="New pages of its device.")
@click.option("--repeats", default=7, show_default=True, type=click.IntRange(0, 1000), help="Timed rounds.")
@click.option("--out", required=True, type=OutputFolder(), help="Folder for run, pages and fidelity.json.")
def main(kept: Path, pages: int, repeats: int, out: Path) -> None:
    """Print what a kept decoder of two passes reads and takes with other waves, and in half precision."""
    profile, device, _ = data_set_of(kept)
    work = out / kept.name
    if not (work / "bundle.zip").exists():
        export_kept(kept, work, work / "bundle.zip")
    models, half = graphs(work)
    shown = work / f"pages-{pages}.h5"
    if not shown.exists():
        job = RecordingJob(profile, device, LEVELS, _SEED, truth=False, out=shown)
        job.claim(force=False)
        job.run(pages)
    with Recording.open(shown) as recording:
        forms = measured(models, half, recording, pilot_mask(profile), repeats, name_of((EXACT, ROUGH)))
    click.echo(f"{'to the cameras; back':<28} {'AIR':>7} {'ms':>8} {'p off, p99':>11}")
    for form in forms:
        milliseconds = f"{1e3 * form.seconds:.1f}" if np.isfinite(form.seconds) else "-"
        click.echo(f"{form.name:<28} {form.air:>7.3f} {milliseconds:>8} {form.deviation:>11.4f}")
    figures = [asdict(form) | {"seconds": form.seconds if np.isfinite(form.seconds) else None} for form in forms]
    write_json(
        out / "fidelity.json", {"data_set": kept.name, "profile": profile.name, "pages": pages, "forms": figures}
    )


if __name__ == "__main__":
    sys.exit(run_command(main, name="python -m analysis.comparison.fidelity"))
