"""Times of both forms of the wave operators, in turns in one run: tiles for one page, planes for many.

    python -m analysis.gpu.wave_forms --threads 2 --json F
    python -m analysis.gpu.wave_forms --profile paper --threads 2 --json F
    python -m analysis.gpu.wave_forms --profile paper --device cuda --json F

Both forms compute light from the modulator to the cameras, and back by the adjoint, with the sampling and fidelity of
the wave localizer. They run as graphs in ONNX Runtime, as in a service; times of eager torch differ. The time of their
matrices is not included. On a GPU, planes are timed in batches of 1 and 4, in float16, as batches are decoded.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional
from torch.utils import _pytree as pytree

from analysis.gpu.in_batches import Machine
from analysis.speed.decode_time import SETTLE_S
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.device.profile import Profile, load_profile
from lightpage.device.state import Device
from lightpage.export.batched import traced
from lightpage.metrics.provenance import write_figures
from lightpage.runtime.model.execution.cpus import available_cpus
from lightpage.runtime.model.execution.providers import CPU, CUDA, Provider
from lightpage.runtime.model.execution.session import BoundSession, open_session
from lightpage.simulator.true_optics import true_parameters
from lightpage.train.models.batched.decoder import WaysBack, WaysThere
from lightpage.train.models.batched.products import PAD, Tables
from lightpage.train.models.waves import WaveMatrices, Waves
from lightpage.waves.grid import symbol_samples

_LIGHT = "light"
_ANSWER = "answer"
Operator = Callable[[Tensor, tuple[Tensor, ...]], Tensor]
"""Function of light [..., rows, columns] and of constants, to light."""


class Way(nn.Module):
    """Forward or adjoint operator of a form, with its constants.

    Args:
        operator: computation of the operator.
        light: example of its input.
        constants: constants that it takes.
        modules: modules that it uses.
    """

    def __init__(
        self, operator: Operator, light: Tensor, constants: Sequence[Tensor], modules: Sequence[nn.Module]
    ) -> None:
        super().__init__()
        self.operator = operator
        self.used = nn.ModuleList(modules)
        self.inputs = (light, *constants)

    def forward(self, light: Tensor, *constants: Tensor) -> Tensor:
        """Apply the operator to light [..., rows, columns]."""
        return self.operator(light, constants)

    def opened(self, provider: Provider, threads: int, *, rounded: bool) -> Any:
        """Open a session of the operator, and bind its inputs and its output on the provider's device."""
        names = [_LIGHT, *(f"constant_{number}" for number in range(len(self.inputs) - 1))]
        model = traced(self, self.inputs, tuple(names), (_ANSWER,))
        entries = {entry.name for entry in model.graph.input}
        session = open_session(model.SerializeToString(), _LIGHT, threads, provider=provider, rounded=rounded)
        inputs = zip(names, self.inputs, strict=True)
        held = BoundSession(
            session, provider, {name: value.numpy() for name, value in inputs if name in entries}, _LIGHT
        )
        binding = held.binding()
        binding.bind_output(_ANSWER, provider.memory, provider.device)
        return session, binding


@dataclass(frozen=True)
class Row:
    """Times of one form.

    Attributes:
        form: name of the form.
        pages: pages of a batch.
        forward_ms, adjoint_ms: median time of a page, to the cameras and back.
        forward_ratio, adjoint_ratio: median ratio of this time to that of the form for one page, in the same turn.
        deviation: larger relative deviation of the two outputs from those of the form for one page.
    """

    form: str
    pages: int
    forward_ms: float
    adjoint_ms: float
    forward_ratio: float
    adjoint_ratio: float
    deviation: float


class Timed:
    """Timed form.

    Args:
        form, pages: see `Row`.
        ways: forward and adjoint operator.
        machine: machine that computes them.
        threads: threads of a CPU.
    """

    def __init__(self, form: str, pages: int, ways: tuple[Way, Way], machine: Machine, threads: int) -> None:
        self.form = form
        self.pages = pages
        self.machine = machine
        self.seconds: tuple[list[float], list[float]] = ([], [])
        self.answers: list[NDArray[np.float32]] = []
        rounded = ways[0].inputs[0].dtype == torch.float16
        self._opened = [way.opened(machine.provider, threads, rounded=rounded) for way in ways]

    def run(self) -> None:
        """Time both operators once."""
        self.answers = []
        for (session, binding), seconds in zip(self._opened, self.seconds, strict=True):
            time.sleep(SETTLE_S)
            start = time.perf_counter()
            session.run_with_iobinding(binding)
            self.machine.wait()
            seconds.append(time.perf_counter() - start)
            answer = binding.copy_outputs_to_cpu()[0].astype(np.float32)
            self.answers.append(answer.reshape(-1, *answer.shape[-3:])[0])

    def row(self, usual: Timed) -> Row:
        """Compare the times with those of the form for one page. The first time of each operator is not used."""
        own, others = (np.array(form.seconds)[:, 1:] / form.pages for form in (self, usual))
        forward, adjoint = 1e3 * np.median(own, 1)
        forward_ratio, adjoint_ratio = np.median(own / others, 1)
        deviation = max(
            float(np.linalg.norm(answer - other) / np.linalg.norm(other))
            for answer, other in zip(self.answers, usual.answers, strict=True)
        )
        return Row(
            form=self.form,
            pages=self.pages,
            forward_ms=float(forward),
            adjoint_ms=float(adjoint),
            forward_ratio=float(forward_ratio),
            adjoint_ratio=float(adjoint_ratio),
            deviation=deviation,
        )


def tiles(waves: Waves, page: Tensor, light: Tensor) -> tuple[Way, Way]:
    """Forward and adjoint operator of the form for one page, with a page and its light at the cameras as examples."""
    constants, spec = pytree.tree_flatten(waves.matrices())

    def way(operator: Callable[[WaveMatrices, Tensor], Tensor], taken: Tensor) -> Way:
        return Way(
            lambda light, constants: operator(pytree.tree_unflatten(constants, spec), light), taken, constants, [waves]
        )

    return way(waves.to_camera, page), way(waves.to_page, light)


def planes(waves: Waves, page: Tensor, light: Tensor, pages: int, dtype: torch.dtype) -> tuple[Way, Way]:
    """Forward and adjoint operator of the form for many pages, with a batch of copies of a page as example."""
    there = WaysThere(waves)
    back = WaysBack(waves)
    forward_tables = there.tables(waves.default)
    adjoint_tables = back.tables(waves.default)
    ny, nx = light.shape[1:]

    def batch(one: Tensor) -> Tensor:
        return one.to(dtype).expand(pages, -1, -1, -1).contiguous()

    def typed(tables: Tables) -> list[Tensor]:
        return [value.to(dtype) for value in tables.values()]

    def forward(batch: Tensor, constants: tuple[Tensor, ...]) -> Tensor:
        tables = dict(zip(forward_tables, constants, strict=True))
        return torch.stack(there.on_grid(there(batch, tables), tables), 1)[..., :ny, :nx]

    def adjoint(batch: Tensor, constants: tuple[Tensor, ...]) -> Tensor:
        tables = dict(zip(adjoint_tables, constants, strict=True))
        sparse = back.sparse((batch[:, 0], batch[:, 1]), tables)
        return back.waves.last.cropped(back.waves(sparse, tables))

    padded = functional.pad(light, (0, -nx % PAD, 0, -ny % PAD))
    return (
        Way(forward, batch(page), typed(forward_tables), [there]),
        Way(adjoint, batch(padded), typed(adjoint_tables), [back]),
    )


def measured(profile: Profile, machine: Machine, threads: int, repeats: int) -> list[Row]:
    """Time all forms in turns, `repeats` times after a first run that is not used."""
    waves = Waves(profile, true_parameters(profile, Device()), symbol_samples(profile)).eval()
    rng = np.random.default_rng(0)
    phases = torch.from_numpy(2 * np.pi * rng.random((len(waves.y_m), len(waves.x_m)))).float()
    page = torch.stack([torch.cos(phases), torch.sin(phases)])
    light = waves.to_camera(waves.matrices(), page)
    on_gpu = machine.device.type == CUDA
    dtype = torch.float16 if on_gpu else torch.float32
    usual = Timed("tiles", 1, tiles(waves, page, light), machine, threads)
    batches = (1, 4) if on_gpu else (1,)
    others = [Timed("planes", pages, planes(waves, page, light, pages, dtype), machine, threads) for pages in batches]
    forms = [usual, *others]
    for _ in range(repeats + 1):
        for form in forms:
            form.run()
    return [form.row(usual) for form in forms]


@click.command()
@click.option("--profile", "profile_name", default="bench", show_default=True, help="Shipped profile or TOML file.")
@click.option("--device", "device_name", default=CPU, show_default=True, type=click.Choice([CPU, CUDA]))
@click.option("--repeats", default=7, show_default=True, type=click.IntRange(1, 1000), help="Timed rounds.")
@click.option("--threads", type=click.IntRange(1), help="Threads of a CPU; the usable cores if left out.")
@click.option("--json", "json_path", type=OutputFile(), required=True, help="Write the figures to this file.")
def main(profile_name: str, device_name: str, repeats: int, threads: int | None, json_path: Path) -> None:
    """Print the times of both forms of the wave operators, and their ratios."""
    profile = load_profile(profile_name)
    threads = threads or available_cpus()
    torch.set_num_threads(threads)
    with torch.no_grad():
        rows = measured(profile, Machine.of(device_name), threads, repeats)
    click.echo(
        f"{'form':<8} {'pages':>5} {'forward, ms':>12} {'ratio':>6} {'adjoint, ms':>12} {'ratio':>6} {'apart':>8}"
    )
    for row in rows:
        click.echo(
            f"{row.form:<8} {row.pages:>5} {row.forward_ms:>12.1f} {row.forward_ratio:>6.2f} "
            f"{row.adjoint_ms:>12.1f} {row.adjoint_ratio:>6.2f} {row.deviation:>8.4f}"
        )
    figures = {"profile": profile.name, "device": device_name, "threads": threads, "repeats": repeats}
    write_figures(json_path, figures | {"forms": [asdict(row) for row in rows]})


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.gpu.wave_forms"))
