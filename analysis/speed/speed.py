"""Time to decode a page from raw frames, every decoder in the same ONNX Runtime, taking turns in one run.

    python -m analysis.speed.speed --profile bench

Untrained: time does not depend on weights. Ratios are over the decoder that is named first. Behind them, where each
decoder's time goes, part by part (`analysis.speed.parts`).
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np
from torch import nn

from analysis.speed.decode_time import frames_of, opened, seconds_of
from analysis.speed.parts import Machine, Part, lines, measured_machine, parts_of
from analysis.speed.untrained_graphs import makers_of
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.device.profile import load_profile
from lightpage.export.onnx_files import decoder_onnx
from lightpage.metrics.provenance import write_figures
from lightpage.runtime.model.execution.cpus import available_cpus

_PROFILED = 3
"""Runs with a profile, which takes a little time itself."""


@dataclass(frozen=True)
class Timed:
    """Median seconds of one decoder, and over the first one's."""

    decoder: str
    seconds: float
    ratio: float
    parameters: int


def profiled(model: bytes, feeds: dict[str, np.ndarray], threads: int, machine: Machine) -> list[Part]:
    """Profile an exported decoder, and return its parts with their times."""
    with tempfile.TemporaryDirectory(prefix="lightpage-") as folder:
        graph = opened(model, threads, Path(folder) / "profile")
        for _ in range(_PROFILED):
            seconds_of(graph, feeds)
        return parts_of(model, Path(graph.session.end_profiling()), _PROFILED, machine)


def weights(graph: nn.Module) -> int:
    return sum(parameter.numel() for parameter in graph.parameters())


@click.command()
@click.option("--profile", "profile_name", default="bench", show_default=True, help="Shipped profile or TOML file.")
@click.option("--decoder", "names", multiple=True, help="Only these; ratios are over the first of them.")
@click.option("--repeats", type=click.IntRange(1, 1000), default=15, show_default=True)
@click.option("--threads", type=click.IntRange(1), help="Threads of one decode; the usable cores if left out.")
@click.option("--parts/--no-parts", default=True, show_default=True, help="Show where each decoder's time goes.")
@click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file.")
def main(
    profile_name: str, names: tuple[str, ...], repeats: int, threads: int | None, parts: bool, json_path: Path | None
) -> None:
    """Time all decoders side by side and print medians and ratios."""
    profile = load_profile(profile_name)
    known = makers_of(profile, names)
    threads = threads or available_cpus()
    models, sessions, sizes = {}, {}, {}
    for name in dict.fromkeys(names or known):
        graph, tensors = known[name]()
        models[name], sizes[name] = decoder_onnx(graph.eval(), "uint8", profile.frame_shape, tensors), weights(graph)
        sessions[name] = opened(models[name], threads)
    feeds = frames_of(profile)
    taken: dict[str, list[float]] = {name: [] for name in sessions}
    for repeat in range(repeats + 1):
        for name, session in sessions.items():  # taking turns: a slow moment meets all of them
            seconds = seconds_of(session, feeds)
            if repeat:
                taken[name].append(seconds)
    medians = {name: float(np.median(values)) for name, values in taken.items()}
    first = next(iter(medians.values()))
    results = [Timed(name, seconds, seconds / first, sizes[name]) for name, seconds in medians.items()]
    click.echo(f"{'decoder':<12} {'ms a page':>10} {'ratio':>7} {'weights':>10}")
    for result in results:
        click.echo(f"{result.decoder:<12} {1e3 * result.seconds:>10.1f} {result.ratio:>7.2f} {result.parameters:>10,}")
    figures: dict[str, Any] = {"profile": profile.name, "threads": threads, "repeats": repeats}
    figures["decoders"] = [asdict(result) for result in results]
    if parts:
        machine = measured_machine(threads)
        click.echo(f"\nthis machine: {machine.flops_per_s / 1e9:.0f} GFLOP/s, {machine.bytes_per_s / 1e9:.0f} GB/s")
        sessions.clear()
        figures |= {"machine": asdict(machine), "parts": {}}
        for name, model in models.items():
            found = profiled(model, feeds, threads, machine)
            click.echo("\n".join([f"\n{name}", *lines(found)]))
            figures["parts"][name] = [asdict(part) for part in found]
    write_figures(json_path, figures, profile=profile.to_toml())


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.speed.speed"))
