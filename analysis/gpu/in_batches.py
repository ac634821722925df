"""Rates of a decoder in batches on a card, its floors, and where its time goes."""

from __future__ import annotations

import math
import re
import time
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from analysis.gpu.kept_form import Form, Scene
from lightpage.export.operators.batches import BatchFile
from lightpage.runtime.model.decoding.batch_graph import SHIFT
from lightpage.runtime.model.execution.providers import CUDA, Provider
from lightpage.runtime.model.execution.session import BoundSession, open_session

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


@dataclass(frozen=True)
class Machine:
    """A machine that decodes.

    Attributes:
        device: torch's.
        provider: ONNX Runtime's.
    """

    device: torch.device
    provider: Provider

    @classmethod
    def of(cls, name: str) -> Machine:
        """The machine of a provider's name, `cuda` or `cpu`."""
        return cls(torch.device(name), Provider.parse(name))

    def wait(self) -> None:
        """Wait until all is computed."""
        if self.device.type == CUDA:
            torch.cuda.synchronize()


def ceilings(machine: Machine) -> dict[str, float]:
    """Measure what the card can do at most: bytes of a copy, flops of a product, bytes over the bus, a second."""
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
    left, right = (torch.randn(side, side, device=device).half() for _ in range(2))
    found["float16_flops"] = rate(lambda: left @ right, 2.0 * side**3)
    if device.type == CUDA:
        pinned = torch.empty(1 << 26, dtype=torch.uint8).pin_memory()
        there = torch.empty(1 << 26, dtype=torch.uint8, device=device)
        found["pinned_bytes_per_s"] = rate(lambda: there.copy_(pinned, non_blocking=True), float(1 << 26))
    return found


class Batches:
    """A batch graph opened for so many pages, with its constants where it computes."""

    def __init__(self, machine: Machine, form: Form, constants: Mapping[str, NDArray[Any]], pages: int) -> None:
        self.machine, self.pages, device = machine, pages, machine.device
        self.session = open_session(form.batch, form.name, provider=machine.provider, rounded=True)
        self._held = BoundSession(self.session, machine.provider, constants, form.name)
        self.frames = [torch.zeros((pages, *form.frame_shape), dtype=torch.uint8, device=device) for _ in range(2)]
        self.shift = torch.zeros((pages, 2, 2), dtype=torch.float32, device=device)
        self.p = torch.zeros((pages, 2, *form.page_shape), dtype=torch.float32, device=device)
        self.residual = torch.zeros(pages, dtype=torch.float32, device=device)

    def bound(self, frames: list[torch.Tensor]) -> Any:
        """A binding of two stacks of frames and of the outputs."""
        binding, kind = self._held.binding(), self.machine.device.type
        for name, tensor, dtype in (("in_phase", frames[0], np.uint8), ("quadrature", frames[1], np.uint8)):
            binding.bind_input(name, kind, 0, dtype, tuple(tensor.shape), tensor.data_ptr())
        binding.bind_input(SHIFT, kind, 0, np.float32, tuple(self.shift.shape), self.shift.data_ptr())
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


def decoded(
    machine: Machine, form: Form, constants: Mapping[str, NDArray[Any]], pages: int, scene: Scene
) -> dict[str, Any]:
    """Rates of a graph alone and from pinned frames to p, and what its answers are worth."""
    batches = Batches(machine, form, constants, pages)
    host = batches.filled(scene)
    for there, here in zip(batches.frames, host, strict=True):
        there.copy_(here)
    machine.wait()
    binding = batches.bound(batches.frames)
    taken = []
    for _ in range(_REPEATS if machine.device.type == CUDA else 2):
        start = time.perf_counter()
        batches.session.run_with_iobinding(binding)
        machine.wait()
        taken.append(time.perf_counter() - start)
    p = batches.p.cpu().numpy()
    found: dict[str, Any] = {
        "pages": batches.pages,
        "graph_ms_a_page": 1e3 * float(np.median(taken[1:])) / batches.pages,
        "residual": [float(each) for each in batches.residual.cpu()[:2]],
        "air": [scene.air(p[page], page % len(scene.pairs)) for page in range(min(2, batches.pages))],
        "deviation": [scene.deviation(form.expected[page], p[page]) for page in range(min(2, batches.pages))],
    }
    if machine.device.type == CUDA:
        found["end_to_end_ms_a_page"] = 1e3 * _end_to_end(batches, host) / batches.pages
        found["alone_ms"] = 1e3 * _alone(batches, host)
        free, total = torch.cuda.mem_get_info()
        found["memory_gb"] = (total - free) / 1e9
        found |= kernels(batches, binding)
    found["pages_per_s"] = 1e3 / found.get("end_to_end_ms_a_page", found["graph_ms_a_page"])
    return found


def _end_to_end(batches: Batches, host: list[torch.Tensor], runs: int = 12) -> float:
    """Seconds a batch from pinned frames to p in pinned memory: the next batch is copied while one is computed."""
    other = [torch.empty_like(each) for each in batches.frames]
    slots = [batches.frames, other]
    bindings = [batches.bound(slot) for slot in slots]
    answers = torch.empty(batches.p.shape, dtype=torch.float32).pin_memory()
    copies = torch.cuda.Stream()  # type: ignore[no-untyped-call]

    def sent(slot: int) -> None:
        with torch.cuda.stream(copies):
            for there, here in zip(slots[slot], host, strict=True):
                there.copy_(here, non_blocking=True)

    sent(0)
    copies.synchronize()
    start = 0.0
    for batch in range(runs + 2):
        if batch == 2:
            start = time.perf_counter()
        sent((batch + 1) % 2)
        batches.session.run_with_iobinding(bindings[batch % 2])
        answers.copy_(batches.p, non_blocking=True)
        torch.cuda.current_stream().synchronize()
        copies.synchronize()
    return (time.perf_counter() - start) / runs


def _alone(batches: Batches, host: list[torch.Tensor]) -> float:
    """Median seconds of a batch that nothing overlaps with, from pinned frames to p in pinned memory."""
    binding = batches.bound(batches.frames)
    answers, taken = torch.empty(batches.p.shape, dtype=torch.float32).pin_memory(), []
    for _ in range(_REPEATS):
        start = time.perf_counter()
        for there, here in zip(batches.frames, host, strict=True):
            there.copy_(here, non_blocking=True)
        torch.cuda.synchronize()
        batches.session.run_with_iobinding(binding)
        answers.copy_(batches.p, non_blocking=True)
        torch.cuda.synchronize()
        taken.append(time.perf_counter() - start)
    return float(np.median(taken))


def kernels(batches: Batches, binding: Any) -> dict[str, Any]:
    """Kernels of a batch, and the GPU's time a page in each group of them, ms."""
    from torch.profiler import ProfilerActivity, profile

    with profile(activities=[ProfilerActivity.CUDA]) as watched:
        batches.session.run_with_iobinding(binding)
        torch.cuda.synchronize()
    events = [event for event in watched.key_averages() if event.self_device_time_total > 0]
    groups: dict[str, float] = defaultdict(float)
    for event in events:
        name = event.key.lower()
        group = next((group for group, pattern in _GROUPS.items() if re.search(pattern, name)), "other")
        groups[group] += event.self_device_time_total / 1e3 / batches.pages
    longest = sorted(events, key=lambda event: -event.self_device_time_total)[:26]
    return {
        "kernels": sum(event.count for event in events),
        "busy_ms_a_page": sum(groups.values()),
        "groups_ms_a_page": {name: round(value, 4) for name, value in sorted(groups.items(), key=lambda g: -g[1])},
        "longest": [
            [round(event.self_device_time_total / 1e3 / batches.pages, 4), event.count, event.key[:110]]
            for event in longest
        ],
    }


def constants_of(form: Form) -> dict[str, NDArray[Any]]:
    """The constants of a form, evaluated on the CPU."""
    first = open_session(form.constants, form.name, once=True)
    names = [output.name for output in first.get_outputs()]
    table = {entry.name: form.defaults[entry.name] for entry in first.get_inputs()}
    return dict(zip(names, first.run(names, table), strict=True))


def floor(form: Form, pages: int, most: Mapping[str, float]) -> dict[str, float]:
    """The least time that a page can take, ms: its bytes at the rate of a copy, its flops at that of a product."""
    cost = BatchFile(form.batch, pages).cost()
    found = {"kernels": cost.kernels, "gigabytes": cost.bytes_a_page / 1e9, "gigaflops": cost.flops_a_page / 1e9}
    found["bytes_ms"] = 1e3 * cost.bytes_a_page / most["copy_bytes_per_s"]
    found["flops_ms"] = 1e3 * cost.flops_a_page / most["float16_flops"]
    if bus := most.get("pinned_bytes_per_s"):
        found["bus_ms"] = 2e3 * math.prod(form.frame_shape) / bus
    return found
