"""Benchmark of bundles on an execution provider: speed, accuracy, and whether every node runs there.

    python -m analysis.speed.provider --provider cuda --bundle fast.zip --bundle accurate.zip --recording pages.h5

Pages of a recording with known symbols are decoded by the provider and by the CPU. AIR is of the provider's answers,
and p is compared with the CPU's in float32. Several callers at once decode different pages, as those of a service do:
frames of one are copied while another's are computed. On a GPU the kernels of a page are counted and timed by torch's
profiler.
"""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path

import click
import numpy as np

from analysis.speed.on_provider import Made, Shown, in_precision, made_by
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.errors import RecordingError
from lightpage.export.half import PRECISIONS
from lightpage.metrics.provenance import write_figures
from lightpage.page.pilots import Pilots
from lightpage.progress import track
from lightpage.recording.reader import Recording
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.bundle.manifest import Precision
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.execution.memory import share_freed_memory
from lightpage.runtime.model.execution.providers import WANTED, Provider
from lightpage.runtime.model.execution.session import VERSION


def pages_of(path: Path, count: int, mask: np.ndarray) -> tuple[list[Shown], int]:
    """The first pages of a recording and its levels.

    Raises:
        RecordingError: no known symbols.
    """
    with Recording.open(path) as recording:
        if not recording.has_symbols:
            raise RecordingError(f"recording {path}", "no dataset 'symbols'", "known symbols to compare with")
        shown = []
        for index in range(min(count, recording.pages)):
            symbols = recording.symbols(index)
            assert symbols is not None
            shown.append(Shown(recording.frames(index), symbols, Pilots.of_symbols(mask, symbols, recording.levels)))
        return shown, recording.levels


def lines(made: Made) -> list[str]:
    """Format the measurements as lines of text."""
    told = [
        f"{made.bundle}, {made.precision}, {made.provider}: loaded in {made.load_s:.1f} s, nodes "
        + ", ".join(f"{count} on {name}" for name, count in made.nodes.items()),
        f"  AIR {made.air:.4f}, p off by {made.deviation:.2g} (99th percentile), {made.symbols_changed:.3%} of symbols "
        "differ from the CPU's in float32",
        f"  one caller: {1e3 * made.infer_s:.1f} ms the graph, {1e3 * made.decode_s:.1f} ms decoded",
    ]
    for callers, pages in made.pages_per_s.items():
        user = "" if made.user_bytes is None else f", {pages * made.user_bytes / 1e6:.2f} MB/s of user bytes"
        told.append(
            f"  {callers} at once: {made.inferences_per_s[callers]:.1f} graphs/s; {pages:.1f} pages/s, "
            f"{pages * made.frame_bytes / 1e9:.2f} GB/s of frames{user}"
        )
    if made.device_bytes is not None and made.busy_s is not None:
        told.append(
            f"  {made.device_bytes / 1e9:.2f} GB of the GPU's memory; computes for {1e3 * made.busy_s:.1f} ms a page, "
            f"in {made.kernel_count} kernels and copies:"
        )
        told += [f"    {1e3 * each.seconds:7.2f} ms in {each.runs:5} of {each.name[:90]}" for each in made.kernels]
    return told


@click.command()
@click.option("--bundle", "paths", multiple=True, required=True, type=click.Path(path_type=Path), help="Bundles.")
@click.option("--recording", required=True, type=click.Path(path_type=Path), help="Pages with known symbols.")
@click.option("--provider", "text", default="cpu", show_default=True, help=f"Processor that computes pages: {WANTED}.")
@click.option("--pages", default=2, show_default=True, type=click.IntRange(1, 1000), help="Pages of the recording.")
@click.option("--precision", "precisions", multiple=True, type=click.Choice(PRECISIONS), default=PRECISIONS)
@click.option(
    "--callers",
    multiple=True,
    type=click.IntRange(1, 64),
    default=(1, 2, 4),
    show_default=True,
    help="Callers at once.",
)
@click.option("--batches", default=1, show_default=True, type=click.IntRange(1, 64), help="Computed together at most.")
@click.option(
    "--seconds", default=5.0, show_default=True, type=click.FloatRange(0.01, 600), help="Seconds for each of them."
)
@click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file.")
def main(
    paths: tuple[Path, ...],
    recording: Path,
    text: str,
    pages: int,
    precisions: tuple[Precision, ...],
    callers: tuple[int, ...],
    batches: int,
    seconds: float,
    json_path: Path | None,
) -> None:
    """Print what a provider makes of bundles of one device: rate, exactness, and where each node runs."""
    provider = Provider.parse(text)
    share_freed_memory()  # as a service does
    made: list[Made] = []
    for path in paths:
        bundle = Bundle.open(path)
        shown, levels = pages_of(recording, pages, bundle.pilot_mask)
        on_cpu = Decoder(bundle)
        usual = [on_cpu.decode(page.pair, levels, pilots=page.pilots) for page in track(shown, "cpu")]
        del on_cpu
        for precision in dict.fromkeys(precisions):
            form = in_precision(bundle, precision)
            made.append(made_by(provider, form, precision, shown, levels, usual, callers, seconds, batches))
            click.echo("\n".join(lines(made[-1])))
            if json_path is not None:  # after each: the next may fail
                write_figures(json_path, {"onnxruntime": VERSION, "made": [asdict(each) for each in made]})


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.speed.provider"))
