"""Accuracy and time of a second pass, by how exactly it models light: weights stay, waves and precision change.

    python -m analysis.speed.fidelity --kept analysis/weights/bench/-0.6deg-32e-4px --out runs/fidelity

New pages of the data set's device are simulated, and every form decodes them as a service would. The times are of
decodes in turns.
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

from analysis.comparison.data_set import data_set_of, simulate
from analysis.comparison.kept_bundle import export_kept
from analysis.speed.decode_time import opened, seconds_of
from lightpage.calibration.sampling_table import sampling_table
from lightpage.cli.main import run as run_command
from lightpage.cli.paths import OutputFolder
from lightpage.export.graph import FRAME_INPUTS, DecoderGraph, table_tensors
from lightpage.export.half import deviation, rounded
from lightpage.export.onnx_files import decoder_onnx
from lightpage.metrics.information import achievable_rate
from lightpage.metrics.provenance import write_figures
from lightpage.page.pilots import Pilots
from lightpage.progress import track
from lightpage.recording.reader import Recording
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.runtime.model.execution import cpus, page_graph
from lightpage.train.models.decoder import SymbolDecoder
from lightpage.train.models.prediction import Prediction
from lightpage.train.models.twin import RayTwin, TorchTwin
from lightpage.train.models.waves import EXACT, ROUGH, Fidelity
from lightpage.train.runs import Run, load_decoder, load_run

Complex = NDArray[np.complexfloating]
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
        name: name for people.
        air: AIR on the pages, bits a symbol.
        seconds: median of a page; NaN where it would say nothing.
        deviation: deviation of p from that of the usual form in float32, over its length, 99th percentile of all
            symbols.
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
        folder: folder of a run of two passes.
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
    return made, rounded(made[name_of((EXACT, ROUGH))], page_graph.PAGE_INPUTS)


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
    decoder: Decoder, models: Mapping[str, bytes], half: bytes, recording: Recording, repeats: int, usual: str
) -> list[Form]:
    """Rates, times and deviations of all forms on the pages of a recording.

    Args:
        decoder: decoder of the run, for all but its graph; each form follows the image by itself, as a service does.
        models: every form's decoder.onnx by name.
        half: the one in half precision.
        recording: pages with symbols.
        repeats: rounds of timing.
        usual: name of the form that p is compared with.
    """
    graphs = {name: opened(model, cpus.available_cpus()) for name, model in {**models, HALF: half}.items()}
    trackers = {name: tracker_for(Decoder(decoder.bundle, graph=graph)) for name, graph in graphs.items()}
    data, levels = ~decoder.bundle.pilot_mask, recording.levels
    rates: dict[str, list[float]] = {name: [] for name in graphs}
    answers: dict[str, list[Complex]] = {name: [] for name in graphs}
    for index in track(range(recording.pages), "decode"):
        pair, symbols = recording.frames(index), recording.symbols(index)
        assert symbols is not None
        pilots = Pilots.of_symbols(~data, symbols, levels)
        for name, tracker in trackers.items():
            page = tracker.decode(pair, levels, pilots)
            answers[name].append((page.concentration * np.exp(1j * page.phase))[data])
            rate = achievable_rate(page.phase[data], page.concentration[data], symbols[data], levels)
            rates[name].append(float(rate.mean()))
    last = recording.frames(recording.pages - 1)
    feeds = dict(zip(FRAME_INPUTS, (last.in_phase, last.quadrature), strict=True))
    taken: dict[str, list[float]] = {name: [] for name in models}
    for _ in track(range(repeats), "time", unit="round"):
        for name in taken:  # taking turns: a slow moment meets all of them
            taken[name].append(seconds_of(graphs[name], feeds))
    whole = {name: np.concatenate(found) for name, found in answers.items()}
    return [
        Form(
            name,
            float(np.mean(rates[name])),
            float(np.median(taken[name])) if taken.get(name) else float("nan"),
            deviation(np.stack([whole[usual].real, whole[usual].imag]), np.stack([whole[name].real, whole[name].imag])),
        )
        for name in graphs
    ]


@click.command()
@click.option(
    "--kept",
    required=True,
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    help="Folder of a data set in analysis/weights.",
)
@click.option("--pages", default=8, show_default=True, type=click.IntRange(1, 1000), help="New pages of its device.")
@click.option("--repeats", default=7, show_default=True, type=click.IntRange(0, 1000), help="Timed rounds.")
@click.option("--out", required=True, type=OutputFolder(), help="Folder for run, pages and fidelity.json.")
def main(kept: Path, pages: int, repeats: int, out: Path) -> None:
    """Print what a kept decoder of two passes reads and takes with other waves, and in half precision."""
    profile, device, _ = data_set_of(kept)
    work = out / kept.name
    bundle = work / "bundle.zip"
    if not bundle.exists():
        export_kept(kept, work, bundle)
    models, half = graphs(work)
    shown = work / f"pages-{pages}.h5"
    simulate(shown, profile, device, pages, _SEED)
    with Recording.open(shown) as recording:
        forms = measured(Decoder.load(bundle), models, half, recording, repeats, name_of((EXACT, ROUGH)))
    click.echo(f"{'to the cameras; back':<28} {'AIR':>7} {'ms':>8} {'p off, p99':>11}")
    for form in forms:
        milliseconds = f"{1e3 * form.seconds:.1f}" if np.isfinite(form.seconds) else "-"
        click.echo(f"{form.name:<28} {form.air:>7.3f} {milliseconds:>8} {form.deviation:>11.4f}")
    figures = [asdict(form) | {"seconds": form.seconds if np.isfinite(form.seconds) else None} for form in forms]
    write_figures(
        out / "fidelity.json", {"data_set": kept.name, "profile": profile.name, "pages": pages, "forms": figures}
    )


if __name__ == "__main__":
    sys.exit(run_command(main, name="python -m analysis.speed.fidelity"))
