"""Behaviour of one bundle on an execution provider: speed, accuracy, and whether every node runs there."""

from __future__ import annotations

import json
import subprocess
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lightpage.export.half import deviation, in_half
from lightpage.metrics.information import achievable_rate
from lightpage.page.pilots import Pilots
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.bundle.manifest import DECODER, FLOAT32, Precision
from lightpage.runtime.model.decoding.batches import Batching
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.page import DecodedPage
from lightpage.runtime.model.execution.page_graph import PAGE_INPUTS
from lightpage.runtime.model.execution.providers import ON_CPU, Provider
from lightpage.runtime.model.execution.table_graph import GraphFile, TableGraph

_ALONE = 11
"""Pages of a single caller, whose median is told."""
_WARM_UP = 2
_KERNELS_TOLD = 8


@dataclass(frozen=True)
class Shown:
    """Frames of a page and the symbols that it was written with."""

    pair: FramePair
    symbols: np.ndarray
    pilots: Pilots


@dataclass(frozen=True)
class Kernel:
    """Runs of one kernel of a GPU in a page."""

    name: str
    runs: int
    seconds: float


@dataclass(frozen=True)
class Made:
    """Measurements of one bundle in one precision on a provider.

    Attributes:
        bundle: name of the bundle.
        precision: precision of network and waves.
        provider: provider as options name it.
        load_s: until the golden page was proven.
        nodes: number of nodes that run for a page, by ONNX Runtime's name of what they run on.
        air: AIR of the provider's answers, bits a symbol, mean of the pages.
        deviation: deviation of p from the CPU's in float32, over its length, 99th percentile of the symbols, worst
            page.
        symbols_changed: share that is another symbol than the CPU's.
        infer_s: median seconds of an inference for a single caller.
        decode_s: median seconds of a decode for a single caller, post-processing included.
        inferences_per_s: rates of inferences, by how many callers run the graph at once.
        pages_per_s: rates of decodes, by how many callers decode at once.
        frame_bytes: bytes of a pair.
        user_bytes: bytes that a page holds by the bundle's code; None without one.
        device_bytes: bytes of the GPU's memory that are taken after all of that, by all programs; None without a GPU.
        busy_s: seconds that the GPU computes for a page, copies included; None without a GPU.
        kernels: kernels that take longest, and how many there are in all; empty without a GPU.
        kernel_count: runs of kernels and copies for a page.
    """

    bundle: str
    precision: str
    provider: str
    load_s: float
    nodes: dict[str, int]
    air: float
    deviation: float
    symbols_changed: float
    infer_s: float
    decode_s: float
    inferences_per_s: dict[int, float]
    pages_per_s: dict[int, float]
    frame_bytes: int
    user_bytes: int | None
    device_bytes: int | None
    busy_s: float | None
    kernels: tuple[Kernel, ...]
    kernel_count: int | None


def in_precision(bundle: Bundle, precision: Precision) -> Bundle:
    """A bundle of float32, or what an export in half precision makes of it."""
    if precision == FLOAT32:
        return bundle
    files = {**bundle.files, DECODER: in_half(bundle.files[DECODER], PAGE_INPUTS)}
    return replace(bundle, manifest=bundle.manifest.model_copy(update={"precision": precision}), files=files)


def placed(bundle: Bundle, provider: Provider) -> dict[str, int]:
    """Count the nodes that run for a page on each provider, by ONNX Runtime's profile."""
    file = GraphFile(bundle.files[DECODER], bundle.subject)
    pair = bundle.golden.pair
    with tempfile.TemporaryDirectory() as folder:
        graph = TableGraph(
            file, bundle.subject, PAGE_INPUTS, None, bundle.table, profile=Path(folder) / "p", provider=provider
        )
        graph.run(["p"], {"in_phase": pair.in_phase, "quadrature": pair.quadrature})
        events = json.loads(Path(graph.session.end_profiling()).read_text())
    named = (event["args"] for event in events if event.get("cat") == "Node" and "args" in event)
    return dict(Counter(each["provider"] for each in named if each.get("provider")))


def rate(call: Callable[[FramePair], object], shown: Sequence[Shown], callers: int, seconds: float) -> float:
    """Calls a second of several callers at once, with pages in turn; raises what a call does."""
    begun, failures = threading.Barrier(callers + 1), list[Exception]()
    ends = [0.0] * callers
    counts = [0] * callers

    def calls(caller: int) -> None:
        try:
            begun.wait()
            stop = time.perf_counter() + seconds
            while time.perf_counter() < stop:
                call(shown[(caller + counts[caller]) % len(shown)].pair)
                counts[caller] += 1
            ends[caller] = time.perf_counter()
        except Exception as error:
            failures.append(error)

    threads = [threading.Thread(target=calls, args=[caller]) for caller in range(callers)]
    for thread in threads:
        thread.start()
    begun.wait()
    start = time.perf_counter()
    for thread in threads:
        thread.join()
    if failures:
        raise failures[0]
    return sum(counts) / (max(ends) - start)


def median_s(call: Callable[[FramePair], object], shown: Sequence[Shown]) -> float:
    """Median time of a call with pages in turn."""
    taken = []
    for index in range(_WARM_UP + _ALONE):
        pair = shown[index % len(shown)].pair
        start = time.perf_counter()
        call(pair)
        taken.append(time.perf_counter() - start)
    return float(np.median(taken[_WARM_UP:]))


def device_bytes(provider: Provider) -> int | None:
    """Memory of a GPU that is taken; None on the CPU."""
    if provider.memory == ON_CPU.memory:
        return None
    asked = ["nvidia-smi", f"--id={provider.device}", "--query-gpu=memory.used", "--format=csv,noheader,nounits"]
    return int(subprocess.run(asked, capture_output=True, text=True, check=True, timeout=60).stdout) << 20


def kernels_of(decoder: Decoder, pair: FramePair) -> list[Kernel]:
    """The kernels and copies of a page on a GPU, the longest first."""
    from torch.profiler import ProfilerActivity, profile

    with profile(activities=[ProfilerActivity.CUDA]) as watched:
        decoder.infer(pair)
    events = [event for event in watched.key_averages() if event.self_device_time_total > 0]
    found = [Kernel(event.key, event.count, event.self_device_time_total * 1e-6) for event in events]
    return sorted(found, key=lambda kernel: -kernel.seconds)


def made_by(
    provider: Provider,
    bundle: Bundle,
    precision: Precision,
    shown: Sequence[Shown],
    levels: int,
    usual: Sequence[DecodedPage],
    callers: Sequence[int],
    seconds: float,
    batches: int = 1,
) -> Made:
    """Figures of one bundle; arguments as the attributes of `Made` and the options of the command name them.

    Args:
        usual: the CPU's answers in float32.
        batches: pages that callers' are computed together, at most.
    """
    nodes = placed(bundle, provider)
    start = time.perf_counter()
    decoder = Decoder(bundle, provider=provider, batching=Batching(batches))
    load_s = time.perf_counter() - start
    data = ~decoder.bundle.pilot_mask
    rates, deviations, changed = [], [], []
    for page, known in zip(shown, usual, strict=True):
        own = decoder.decode(page.pair, levels, pilots=page.pilots)
        rates.append(achievable_rate(own.phase[data], own.concentration[data], page.symbols[data], levels).mean())
        deviations.append(deviation(_p(known)[:, data], _p(own)[:, data]))
        changed.append((own.symbols != known.symbols)[data].mean())
    infer_s = median_s(decoder.infer, shown)
    decode_s = median_s(lambda pair: decoder.decode(pair, levels), shown)
    inferences_per_s = {count: rate(decoder.infer, shown, count, seconds) for count in callers}
    pages_per_s = {count: rate(lambda pair: decoder.decode(pair, levels), shown, count, seconds) for count in callers}
    on_gpu = provider.memory != ON_CPU.memory
    kernels = kernels_of(decoder, shown[0].pair) if on_gpu else []
    return Made(
        bundle=bundle.path.stem,
        precision=precision,
        provider=str(provider),
        load_s=load_s,
        nodes=nodes,
        air=float(np.mean(rates)),
        deviation=max(deviations),
        symbols_changed=float(np.mean(changed)),
        infer_s=infer_s,
        decode_s=decode_s,
        inferences_per_s=inferences_per_s,
        pages_per_s=pages_per_s,
        frame_bytes=shown[0].pair.in_phase.nbytes + shown[0].pair.quadrature.nbytes,
        user_bytes=None if bundle.code is None else decoder.page_codec.user_bytes,
        device_bytes=device_bytes(provider),
        busy_s=sum(kernel.seconds for kernel in kernels) if on_gpu else None,
        kernels=tuple(kernels[:_KERNELS_TOLD]),
        kernel_count=sum(kernel.runs for kernel in kernels) if on_gpu else None,
    )


def _p(page: DecodedPage) -> np.ndarray:
    """A page's answers as real and imaginary parts."""
    p = page.concentration * np.exp(1j * page.phase)
    return np.stack([p.real, p.imag])
