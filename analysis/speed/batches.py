"""How fast a GPU decodes pages in batches, how exactly, and where its time goes.

    python -m analysis.speed.batches --out runs/bench-gpu

Kept decoders of the full-size page are put into their batched form, and decode pages that are simulated here. What is
measured is kept part by part in `gpu.json`, with the card's name; when run again, it goes on behind the last part. It
needs torch, and an ONNX Runtime that has the provider.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
import traceback
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch
from numpy.typing import NDArray

from analysis.speed.kept_form import Form, Scene, forms, scene_of
from lightpage.files import write_json

CUDA = "cuda"
PARTS = "parts"
_REPEATS = 9
_GROUPS = {
    "copies": r"memcpy|memset",
    "sampling": r"gridsample|grid_sample",
    "layout in and out of convolutions": r"nchwtonhwc|nhwctonchw|tensortransform",
    "convolutions": r"conv|cudnn|fprop|implicit",
    "products": r"gemm|cutlass|nvjet|cublas|splitk|gemv|dot_kernel",
    "transposes": r"transpose",
    "pads, slices, joins, splits": r"pad|slice|concat|split|gather",
    "casts": r"cast|convert",
    "products and sums by element": r"elementwise|_mul|_add|_sub|_div|binary|unary|vectorized",
    "reductions": r"reduce|softmax",
}
"""Kernels by what their names hold; the first that fits counts."""


class Kept:
    """Results in a file, part by part: what is there is not measured again.

    Args:
        path: of the file.
        head: what is said once.
    """

    def __init__(self, path: Path, head: Mapping[str, Any]) -> None:
        self.path = path
        self.whole: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {PARTS: {}}
        self.whole |= head

    def part(self, name: str, measure: Callable[[], Any]) -> Any:
        """A part, measured now unless it is there; a failure is told and tried again the next time."""
        if name in self.whole[PARTS]:
            return self.whole[PARTS][name]
        start = time.perf_counter()
        try:
            found = measure()
        except Exception as error:
            traceback.print_exc(limit=5)
            click.echo(f"{name}: failed, {error}"[:300])
            return None
        self.whole[PARTS][name] = found
        write_json(self.path, self.whole)
        click.echo(f"{name} ({time.perf_counter() - start:.1f} s): {json.dumps(found)[:2000]}")
        return found


@dataclass
class Machine:
    """What decodes.

    Attributes:
        device: torch's.
        providers: ONNX Runtime's, with their options.
    """

    device: torch.device
    providers: list[Any]

    @classmethod
    def of(cls, name: str) -> Machine:
        """The machine of a provider's name, `cuda` or `cpu`."""
        cpu = "CPUExecutionProvider"
        if name != CUDA:
            return cls(torch.device("cpu"), [cpu])
        # no place goes through a product, and without TF32 cuDNN keeps float16 off the tensor cores as well
        return cls(torch.device(CUDA), [("CUDAExecutionProvider", {"device_id": 0, "use_tf32": 1}), cpu])

    def wait(self) -> None:
        """Until all is computed."""
        if self.device.type == CUDA:
            torch.cuda.synchronize()


def ceilings(machine: Machine) -> dict[str, float]:
    """What the card can do at most: bytes of a copy, flops of a product, bytes over the bus, a second."""
    device, found = machine.device, {}

    def rate(work: Callable[[], Any], amount: float) -> float:
        work()
        machine.wait()
        start = time.perf_counter()
        for _ in range(5):
            work()
        machine.wait()
        return amount * 5 / (time.perf_counter() - start)

    count, side = (1 << 28, 8192) if device.type == CUDA else (1 << 22, 256)
    source = torch.randn(count, device=device)
    target = torch.empty_like(source)
    found["copy_bytes_per_s"] = rate(lambda: target.copy_(source), 8.0 * count)
    del source, target
    left, right = (torch.randn(side, side, device=device).half() for _ in range(2))
    found["float16_flops"] = rate(lambda: left @ right, 2.0 * side**3)
    if device.type == CUDA:
        pinned = torch.empty(1 << 26, dtype=torch.uint8).pin_memory()
        there = torch.empty(1 << 26, dtype=torch.uint8, device=device)
        found["pinned_bytes_per_s"] = rate(lambda: there.copy_(pinned, non_blocking=True), float(1 << 26))
    return found


class Session:
    """A batch graph opened for so many pages, with its constants where it computes."""

    def __init__(
        self, machine: Machine, form: Form, constants: Mapping[str, NDArray[Any]], pages: int, **options: Any
    ) -> None:
        import onnxruntime

        settings = onnxruntime.SessionOptions()
        settings.log_severity_level = 4
        settings.add_free_dimension_override_by_name("pages", pages)
        providers = machine.providers
        if options:
            providers = [(providers[0][0], providers[0][1] | options), *providers[1:]]
        self.machine, self.pages = machine, pages
        self.session = onnxruntime.InferenceSession(form.batch, settings, providers=providers)
        kind = machine.device.type
        self.held = {
            name: onnxruntime.OrtValue.ortvalue_from_numpy(value, kind, 0) for name, value in constants.items()
        }
        rows, columns = form.frame_shape
        self.frames = [
            torch.zeros((pages, rows, columns), dtype=torch.uint8, device=machine.device) for _ in range(2)
        ]
        self.p = torch.zeros((pages, 2, *form.page_shape), dtype=torch.float32, device=machine.device)
        self.residual = torch.zeros(pages, dtype=torch.float32, device=machine.device)

    def bound(self, frames: list[torch.Tensor]) -> Any:
        """A binding of two stacks of frames and of the outputs."""
        binding, kind = self.session.io_binding(), self.machine.device.type
        for name, value in self.held.items():
            binding.bind_ortvalue_input(name, value)
        for name, tensor, dtype in (("in_phase", frames[0], np.uint8), ("quadrature", frames[1], np.uint8)):
            binding.bind_input(name, kind, 0, dtype, tuple(tensor.shape), tensor.data_ptr())
        for name, tensor in (("p", self.p), ("residual", self.residual)):
            binding.bind_output(name, kind, 0, np.float32, tuple(tensor.shape), tensor.data_ptr())
        return binding

    def filled(self, scene: Scene) -> list[torch.Tensor]:
        """Frames of the scene's pages in turn, on the host."""
        count = len(scene.pairs)
        stacks = [
            torch.from_numpy(np.stack([getattr(scene.pairs[page % count], name) for page in range(self.pages)]))
            for name in ("in_phase", "quadrature")
        ]
        return [stack.pin_memory() for stack in stacks] if self.machine.device.type == CUDA else stacks


def decoded(session: Session, scene: Scene, form: Form) -> dict[str, Any]:
    """Rates of a graph alone and from pinned frames to p, and what its answers are worth."""
    machine, host = session.machine, session.filled(scene)
    for there, here in zip(session.frames, host, strict=True):
        there.copy_(here)
    machine.wait()
    binding = session.bound(session.frames)
    taken = []
    for _ in range(_REPEATS if machine.device.type == CUDA else 2):
        start = time.perf_counter()
        session.session.run_with_iobinding(binding)
        machine.wait()
        taken.append(time.perf_counter() - start)
    p = session.p.cpu().numpy()
    found: dict[str, Any] = {
        "pages": session.pages,
        "graph_ms_a_page": 1e3 * float(np.median(taken[1:])) / session.pages,
        "residual": [float(each) for each in session.residual.cpu()[:2]],
        "air": [scene.air(p[page], page % len(scene.pairs)) for page in range(min(2, session.pages))],
        "deviation": [scene.deviation(form.expected[page], p[page]) for page in range(min(2, session.pages))],
    }
    if machine.device.type == CUDA:
        found["end_to_end_ms_a_page"] = 1e3 * _end_to_end(session, host) / session.pages
        found["memory_gb"] = (lambda free, total: (total - free) / 1e9)(*torch.cuda.mem_get_info())
        found |= kernels(session, binding)
    found["pages_per_s"] = 1e3 / found.get("end_to_end_ms_a_page", found["graph_ms_a_page"])
    return found


def _end_to_end(session: Session, host: list[torch.Tensor], batches: int = 12) -> float:
    """Seconds a batch from pinned frames to p in pinned memory: the next batch is copied while one is computed."""
    other = [torch.empty_like(each) for each in session.frames]
    slots = [session.frames, other]
    bindings = [session.bound(slot) for slot in slots]
    answers = torch.empty(session.p.shape, dtype=torch.float32).pin_memory()
    copies = torch.cuda.Stream()

    def sent(slot: int) -> None:
        with torch.cuda.stream(copies):
            for there, here in zip(slots[slot], host, strict=True):
                there.copy_(here, non_blocking=True)

    sent(0)
    copies.synchronize()
    start = 0.0
    for batch in range(batches + 2):
        if batch == 2:
            start = time.perf_counter()
        sent((batch + 1) % 2)
        session.session.run_with_iobinding(bindings[batch % 2])
        answers.copy_(session.p, non_blocking=True)
        torch.cuda.current_stream().synchronize()
        copies.synchronize()
    return (time.perf_counter() - start) / batches


def kernels(session: Session, binding: Any) -> dict[str, Any]:
    """Kernels of a batch, and the GPU's time a page in each group of them, ms."""
    from torch.profiler import ProfilerActivity, profile

    with profile(activities=[ProfilerActivity.CUDA]) as watched:
        session.session.run_with_iobinding(binding)
        torch.cuda.synchronize()
    events = [event for event in watched.key_averages() if event.self_device_time_total > 0]
    groups: dict[str, float] = defaultdict(float)
    for event in events:
        name = event.key.lower()
        group = next((group for group, pattern in _GROUPS.items() if re.search(pattern, name)), "other")
        groups[group] += event.self_device_time_total / 1e3 / session.pages
    longest = sorted(events, key=lambda event: -event.self_device_time_total)[:26]
    return {
        "kernels": sum(event.count for event in events),
        "busy_ms_a_page": sum(groups.values()),
        "groups_ms_a_page": {name: round(value, 4) for name, value in sorted(groups.items(), key=lambda g: -g[1])},
        "longest": [
            [round(event.self_device_time_total / 1e3 / session.pages, 4), event.count, event.key[:110]]
            for event in longest
        ],
    }


def constants_of(form: Form) -> dict[str, NDArray[Any]]:
    """The constants of a form, evaluated on the CPU."""
    import onnxruntime

    settings = onnxruntime.SessionOptions()
    settings.log_severity_level = 4
    first = onnxruntime.InferenceSession(form.constants, settings, providers=["CPUExecutionProvider"])
    names = [output.name for output in first.get_outputs()]
    return dict(zip(names, first.run(names, dict(form.defaults)), strict=True))


def measured(kept: Kept, machine: Machine, form: Form, scene: Scene, batches: tuple[int, ...]) -> None:
    """All parts of one form."""
    start = time.perf_counter()
    constants = constants_of(form)
    size = sum(value.nbytes for value in constants.values())
    files = {"constants": len(form.constants), "batch": len(form.batch)}
    told = {"files": files, "bytes": size, "seconds": time.perf_counter() - start}
    kept.part(f"{form.name}, constants", lambda: told)
    for pages in batches:
        kept.part(
            f"{form.name}, {pages} a batch", lambda: decoded(Session(machine, form, constants, pages), scene, form)
        )


@click.command()
@click.option(
    "--kept",
    "folder",
    default=Path("analysis/weights/paper/-0.6deg-32e-4px"),
    show_default=True,
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    help="Folder of a data set with kept decoders.",
)
@click.option("--preset", "presets", multiple=True, default=("standard", "fast", "accurate"), show_default=True)
@click.option("--reflections", default=4, show_default=True, help="Rounds to the field of the slower presets.")
@click.option("--batch", "batches", multiple=True, type=int, default=(8, 1), show_default=True, help="Pages a batch.")
@click.option("--provider", default=CUDA, show_default=True, type=click.Choice([CUDA, "cpu"]))
@click.option("--seconds", default=480.0, show_default=True, help="No form is begun after that time.")
@click.option("--pages", "simulated", type=click.Path(path_type=Path), help="Folder for simulated pages; --out's.")
@click.option("--out", required=True, type=click.Path(path_type=Path), help="Folder for gpu.json.")
def main(
    folder: Path,
    presets: tuple[str, ...],
    reflections: int,
    batches: tuple[int, ...],
    provider: str,
    seconds: float,
    simulated: Path | None,
    out: Path,
) -> None:
    """Measure the batched forms of kept decoders."""
    begun = time.perf_counter()
    out.mkdir(parents=True, exist_ok=True)
    (simulated or out).mkdir(parents=True, exist_ok=True)
    machine = Machine.of(provider)
    if provider == CUDA:
        import onnxruntime

        onnxruntime.preload_dlls()
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = False
    card = torch.cuda.get_device_name(0) if provider == CUDA else "cpu"
    commit = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=False).stdout.strip()
    command = f"python -m analysis.speed.batches {' '.join(sys.argv[1:])}"
    kept = Kept(out / "gpu.json", {"card": card, "command": command, "commit": os.environ.get("COMMIT", commit)})
    kept.part("ceilings", lambda: ceilings(machine))
    scene = scene_of(folder, simulated or out)
    for form in forms(folder, scene, presets, reflections, machine.device):
        if time.perf_counter() - begun > seconds:
            break
        kept.part(f"{form.name}, present", lambda form=form: form.told)
        measured(kept, machine, form, scene, batches)
    click.echo(f"{kept.path}: {time.perf_counter() - begun:.0f} s")


if __name__ == "__main__":
    main()
