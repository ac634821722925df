"""Time to decode a page from raw frames, every decoder in the same ONNX Runtime, taking turns in one run.

    python -m analysis.speed.speed --profile bench

Untrained: time does not depend on weights. Ratios are over the decoder that is named first. Behind them, where each
decoder's time goes, part by part (`analysis.speed.parts`).
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable, Collection
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np
from torch import nn

from analysis.speed.parts import Machine, Part, lines, measured_machine, parts_of
from lightpage.calibration.parameters import nominal
from lightpage.calibration.sampling_table import sampling_table
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.device.profile import Profile, load_profile
from lightpage.export.graph import (
    FRAME_INPUTS,
    DecoderGraph,
    Graph,
    PublishedGraph,
    published_tensors,
    table_tensors,
)
from lightpage.export.onnx_files import decoder_onnx
from lightpage.files import write_json
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.decoding.decoder import PAGE_INPUTS
from lightpage.runtime.model.execution.cpus import available_cpus
from lightpage.runtime.model.execution.table_graph import GraphFile, TableGraph
from lightpage.train.models.decoder import SymbolDecoder
from lightpage.train.models.hyperparameters import Hyperparameters
from lightpage.train.models.presets import FAST, PRESETS
from lightpage.train.models.twin import RayTwin, TorchTwin
from lightpage.train.published.trainer import published_decoder
from lightpage.train.published.training import PublishedChoices

Tensors = dict[str, np.ndarray]
SETTLE_S = 0.2
"""Pause before a decode: the threads of the one before spin for a while, and would be in its way."""
_PROFILED = 3
"""Runs with a profile, which takes a little time itself."""
FIRST_LOOK = Hyperparameters()
OWN = {
    "coherent": ("coherent", FIRST_LOOK),
    "refined": ("coherent", Hyperparameters(refinements=1)),
    FAST: ("coherent", PRESETS[FAST].choices),
    "wave": ("wave", FIRST_LOOK),
}
"""Decoders at symbol pitch: localizer and choices by name."""
WIDTHS = {"ray 16/32": (16, 32), "ray 32/64": (32, 64), "ray 64/128": (64, 128)}
"""The published decoder with its ray grid, by the channels of its U-Net."""


def reference(profile: Profile) -> FramePair:
    """Reference-only frames of an even beam."""
    frame = np.full(profile.frame_shape, 100, dtype=np.uint8)
    return FramePair(frame, frame)


def at_symbol_pitch(profile: Profile, localizer: str, choices: Hyperparameters) -> tuple[Graph, Tensors]:
    """A decoder of ours, at an angle of -0.6 degree: a square pipe would need no splitting steps."""
    parameters = nominal()
    parameters[0] = np.deg2rad(-0.6)
    table = sampling_table(TorchTwin(RayTwin(profile)), parameters, np.pi / 2, profile)
    decoder = SymbolDecoder(profile, parameters, localizer, choices)
    graph = DecoderGraph(profile, decoder, 1.0)
    return graph, table_tensors(graph, table, reference(profile))


def published(profile: Profile, localizer: str, channels: tuple[int, int]) -> tuple[Graph, Tensors]:
    """A published decoder."""
    choices = PublishedChoices(channels=channels)
    decoder = published_decoder(localizer, choices, profile, reference(profile), np.pi / 2)
    return PublishedGraph(decoder, 1.0), published_tensors(decoder)


def makers(profile: Profile) -> dict[str, Callable[[], tuple[Graph, Tensors]]]:
    """Every decoder by name; the others are compared with the first."""
    rays = {name: lambda width=width: published(profile, "ray", width) for name, width in WIDTHS.items()}
    own = {name: lambda chosen=chosen: at_symbol_pitch(profile, *chosen) for name, chosen in OWN.items()}
    return {
        **own,
        **rays,
        "mode 32/64": lambda: published(profile, "mode", (32, 64)),
    }


def makers_of(profile: Profile, names: Collection[str]) -> dict[str, Callable[[], tuple[Graph, Tensors]]]:
    """The `makers`, among which somebody asks for some.

    Raises:
        click.BadParameter: a name that is none.
    """
    known = makers(profile)
    for name in names:
        if name not in known:
            raise click.BadParameter(f"{name!r}: wanted one of {', '.join(known)}", param_hint="--decoder")
    return known


@dataclass(frozen=True)
class Timed:
    """Median seconds of one decoder, and over the first one's."""

    decoder: str
    seconds: float
    ratio: float
    parameters: int


def opened(model: bytes, threads: int, profile: Path | None = None) -> TableGraph:
    """An exported decoder in the runtime that serves; `profile` as for `open_session`."""
    return TableGraph(GraphFile(model, "speed"), "speed", PAGE_INPUTS, threads, profile=profile)


def profiled(model: bytes, feeds: dict[str, np.ndarray], threads: int, machine: Machine) -> list[Part]:
    """Where an exported decoder's time goes."""
    with tempfile.TemporaryDirectory(prefix="lightpage-") as folder:
        graph = opened(model, threads, Path(folder) / "profile")
        for _ in range(_PROFILED):
            seconds_of(graph, feeds)
        return parts_of(model, Path(graph.session.end_profiling()), _PROFILED, machine)


def frames_of(profile: Profile) -> dict[str, np.ndarray]:
    """A frame pair of noise: times do not depend on what is seen."""
    rng = np.random.default_rng(0)
    return {name: rng.integers(60, 140, profile.frame_shape, dtype=np.uint8) for name in FRAME_INPUTS}


def seconds_of(graph: TableGraph, feeds: dict[str, np.ndarray]) -> float:
    """How long one decode takes, the threads of the one before at rest."""
    time.sleep(SETTLE_S)
    start = time.perf_counter()
    graph.run(["p"], feeds)
    return time.perf_counter() - start


def weights(graph: nn.Module) -> int:
    return sum(parameter.numel() for parameter in graph.parameters())


@click.command()
@click.option("--profile", "profile_name", default="bench", show_default=True, help="Shipped profile or TOML file.")
@click.option("--decoder", "names", multiple=True, help="Only these; ratios are over the first of them.")
@click.option("--repeats", type=click.IntRange(1, 1000), default=15, show_default=True)
@click.option("--threads", type=click.IntRange(1), help="Of one decode; the usable cores if left out.")
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
    if json_path is not None:
        write_json(json_path, figures)


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.speed.speed"))
