"""Times of both forms of the wave operators, in turns in one run: tiles and blocks for one page, planes for many.

    python -m analysis.gpu.wave_forms --threads 2 --json F
    python -m analysis.gpu.wave_forms --profile paper --threads 2 --json F
    python -m analysis.gpu.wave_forms --profile paper --device cuda --json F

Both forms take pages from the modulator to the cameras, and fields back by the adjoint, with the sampling and fidelity
of the wave localizer. Their matrices are made before. On a GPU the planes are timed in batches of 1 and 4, in float32
as the tiles, and in float16.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import click
import numpy as np
import torch
from torch import Tensor

from analysis.gpu.in_batches import Machine
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.device.profile import Profile, load_profile
from lightpage.device.state import Device
from lightpage.metrics.provenance import write_figures
from lightpage.runtime.model.execution.cpus import available_cpus
from lightpage.runtime.model.execution.providers import CPU, CUDA
from lightpage.simulator.true_optics import true_parameters
from lightpage.train.models.batched.decoder import WaysBack, WaysThere
from lightpage.train.models.batched.products import PAD, Tables
from lightpage.train.models.waves import Waves
from lightpage.waves.grid import symbol_samples

Way = Callable[[], Tensor]
"""Computes a batch of pages or fields, [B, 2, rows, columns], or one of them, [2, rows, columns]."""


@dataclass(frozen=True)
class Row:
    """Times of a form.

    Attributes:
        form: name of the form, with its type of numbers.
        pages: pages of a batch.
        forward_ms, adjoint_ms: median time a page to the cameras, and back.
        forward_ratio, adjoint_ratio: median of the same over the time of the form for one page in the same turn.
        deviation: largest relative deviation of either answer from that of the form for one page.
    """

    form: str
    pages: int
    forward_ms: float
    adjoint_ms: float
    forward_ratio: float
    adjoint_ratio: float
    deviation: float


@dataclass
class Timed:
    """A form while it is timed.

    Attributes:
        form, pages: see `Row`.
        ways: forward and adjoint.
        seconds: times of either.
        answers: last answer of either.
    """

    form: str
    pages: int
    ways: tuple[Way, Way]
    seconds: tuple[list[float], list[float]] = field(default_factory=lambda: ([], []))
    answers: list[Tensor] = field(default_factory=list)

    def run(self, machine: Machine) -> None:
        """Time both ways once."""
        self.answers = []
        for way, seconds in zip(self.ways, self.seconds, strict=True):
            machine.wait()
            start = time.perf_counter()
            answer = way()
            machine.wait()
            seconds.append(time.perf_counter() - start)
            self.answers.append(answer.float().reshape(-1, *answer.shape[-3:])[0])

    def row(self, usual: Timed) -> Row:
        """Return its figures beside those of the form for one page; the first time of either way does not count."""
        own, others = (np.array(form.seconds)[:, 1:] / form.pages for form in (self, usual))
        forward, adjoint = 1e3 * np.median(own, 1)
        forward_ratio, adjoint_ratio = np.median(own / others, 1)
        deviation = max(
            float((answer - other).norm() / other.norm())
            for answer, other in zip(self.answers, usual.answers, strict=True)
        )
        return Row(
            self.form,
            self.pages,
            float(forward),
            float(adjoint),
            float(forward_ratio),
            float(adjoint_ratio),
            deviation,
        )


def tiles(waves: Waves, page: Tensor, light: Tensor) -> tuple[Way, Way]:
    """Forward and adjoint of the form for one page, of a page and its light at the cameras."""
    at = waves.matrices()
    return lambda: waves.to_camera(at, page), lambda: waves.to_page(at, light)


def planes(waves: Waves, page: Tensor, light: Tensor, pages: int, dtype: torch.dtype) -> tuple[Way, Way]:
    """Forward and adjoint of the form for many pages, of a batch of the same page."""
    there, back = WaysThere(waves).to(page.device), WaysBack(waves).to(page.device)

    def typed(tables: Tables) -> Tables:
        return {name: value.to(dtype) for name, value in tables.items()}

    with_page, with_field = typed(there.tables(waves.default)), typed(back.tables(waves.default))
    ny, nx = light.shape[1:]
    batch = page.to(dtype).expand(pages, -1, -1, -1).contiguous()
    whole = torch.nn.functional.pad(light.to(dtype), (0, -nx % PAD, 0, -ny % PAD)).expand(pages, -1, -1, -1)
    real, imaginary = whole[:, 0].contiguous(), whole[:, 1].contiguous()

    def forward() -> Tensor:
        return torch.stack(there.on_grid(there(batch, with_page), with_page), 1)[..., :ny, :nx]

    def adjoint() -> Tensor:
        sparse = back.sparse((real, imaginary), with_field)
        return back.waves.last.cropped(back.waves(sparse, with_field))

    return forward, adjoint


def measured(profile: Profile, machine: Machine, repeats: int) -> list[Row]:
    """Time all forms in turns, `repeats` times after one that does not count."""
    device, rng = machine.device, np.random.default_rng(0)
    waves = Waves(profile, true_parameters(profile, Device()), symbol_samples(profile)).eval().to(device)
    phases = torch.from_numpy(2 * np.pi * rng.random((len(waves.y_m), len(waves.x_m)))).float().to(device)
    page = torch.stack([torch.cos(phases), torch.sin(phases)])
    light = waves.to_camera(waves.matrices(), page)
    usual = Timed("tiles, float32", 1, tiles(waves, page, light))
    forms, batches = [usual], [(torch.float32, 1)]
    if device.type == CUDA:
        batches += [(torch.float32, 4), (torch.float16, 1), (torch.float16, 4)]
    for dtype, pages in batches:
        name = f"planes, {str(dtype).removeprefix('torch.')}"
        forms.append(Timed(name, pages, planes(waves, page, light, pages, dtype)))
    for _ in range(repeats + 1):
        for form in forms:
            form.run(machine)
    return [form.row(usual) for form in forms]


@click.command()
@click.option("--profile", "profile_name", default="bench", show_default=True, help="Shipped profile or TOML file.")
@click.option("--device", "device_name", default=CPU, show_default=True, type=click.Choice([CPU, CUDA]))
@click.option("--repeats", default=7, show_default=True, type=click.IntRange(1, 1000), help="Timed rounds.")
@click.option("--threads", type=click.IntRange(1), help="Threads of a CPU; the usable cores if left out.")
@click.option("--json", "json_path", type=OutputFile(), required=True, help="Write the figures to this file.")
def main(profile_name: str, device_name: str, repeats: int, threads: int | None, json_path: Path) -> None:
    """Print the times of both forms of the wave operators, and their ratios."""
    profile, threads = load_profile(profile_name), threads or available_cpus()
    torch.set_num_threads(threads)
    with torch.no_grad():
        rows = measured(profile, Machine.of(device_name), repeats)
    click.echo(
        f"{'form':<18} {'pages':>5} {'forward, ms':>12} {'ratio':>6} {'adjoint, ms':>12} {'ratio':>6} {'apart':>8}"
    )
    for row in rows:
        click.echo(
            f"{row.form:<18} {row.pages:>5} {row.forward_ms:>12.1f} {row.forward_ratio:>6.2f} "
            f"{row.adjoint_ms:>12.1f} {row.adjoint_ratio:>6.2f} {row.deviation:>8.4f}"
        )
    figures = {"profile": profile.name, "device": device_name, "threads": threads, "repeats": repeats}
    write_figures(json_path, figures | {"forms": [asdict(row) for row in rows]})


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.gpu.wave_forms"))
