"""Breakdown of a page's time: the parts of a decoder, each against its floor, from the runtime's own profile.

A part's floor is the larger of its arithmetic at the runtime's measured peak and of its bytes at the measured memory
bandwidth: what it takes from other parts, its weights, and what it gives to others. All else that it moves could stay
near the processor.
"""

from __future__ import annotations

import json
import math
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx

from lightpage.errors import InvalidInputError
from lightpage.runtime.model.execution.session import open_session

_SIDE = 2048
"""Side of the square matrices whose product measures the peak."""
_LARGE = 1 << 25
"""Numbers that the measurement of the bandwidth reads twice and writes once: far more than a cache holds."""
_REPEATS = 5
_BYTES = 4
OTHER = "answers"
_PARTS = (
    ("decoder/prediction/waves/_pipe", "second pass, to camera: pipe"),
    ("decoder/prediction/back/_pipe", "second pass, to page: pipe"),
    ("decoder/prediction", "second pass: lenses, innovation"),
    ("decoder/localizer/waves/_pipe", "sampling: pipe"),
    ("decoder/localizer", "sampling"),
    ("decoder/network", "network"),
    ("decoder/refiners", "second pass: network"),
    ("decoder", "field"),
    ("recovery", "field"),
)
"""Beginnings of the names of a part's nodes, the first that fits counts."""
FIELD = "field"
_ORDER = (
    FIELD,
    "sampling",
    "sampling: pipe",
    "network",
    *(part for _, part in _PARTS if part.startswith("second")),
    OTHER,
)
"""Order in which a page passes the parts."""


@dataclass(frozen=True)
class Machine:
    """Peak rates that the runtime reaches on this machine.

    Attributes:
        flops_per_s: rate in a product of large matrices of float32.
        bytes_per_s: read and written together, in a sum of arrays that no cache holds.
    """

    flops_per_s: float
    bytes_per_s: float


@dataclass(frozen=True)
class Part:
    """Part of a decoder, with its cost for a page.

    Attributes:
        name: name of the part.
        seconds: seconds that its nodes take.
        flops: operations of products and convolutions, two for a multiplication with an addition.
        bytes: bytes from other parts, of weights, and to other parts.
        floor_s: see the module.
    """

    name: str
    seconds: float
    flops: float
    bytes: float
    floor_s: float


def measured_machine(threads: int) -> Machine:
    """The machine as the runtime uses it with so many threads."""
    square = np.random.default_rng(0).standard_normal((_SIDE, _SIDE)).astype(np.float32)
    product = _fastest("MatMul", [square, square], threads)
    long = np.ones(_LARGE, np.float32)
    total = _fastest("Add", [long, long], threads)
    return Machine(2 * _SIDE**3 / product, 3 * _BYTES * _LARGE / total)


def _fastest(operator: str, inputs: Sequence[np.ndarray], threads: int) -> float:
    """Seconds of the fastest run of one operator."""
    ports = [
        onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, array.shape)
        for name, array in zip("ab", inputs, strict=True)
    ]
    out = onnx.helper.make_tensor_value_info("c", onnx.TensorProto.FLOAT, inputs[0].shape)
    graph = onnx.helper.make_graph([onnx.helper.make_node(operator, ["a", "b"], ["c"])], "one", ports, [out])
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 20)], ir_version=9)
    session = open_session(model.SerializeToString(), "one operator", threads)
    taken = []
    for _ in range(_REPEATS):
        start = time.perf_counter()
        session.run(["c"], dict(zip("ab", inputs, strict=True)))
        taken.append(time.perf_counter() - start)
    return min(taken)


def parts_of(model: bytes, profile: Path, runs: int, machine: Machine) -> list[Part]:
    """The parts of a decoder, in the order in which a page passes them.

    Args:
        model: the exported decoder, whose nodes are named after the modules that they come from.
        profile: the runtime's profile of it.
        runs: number of runs in the profile; the first is left out where there are more.
        machine: machine that it ran on.

    Raises:
        InvalidInputError: a profile without nodes.
    """
    seconds: defaultdict[str, float] = defaultdict(float)
    flops: defaultdict[str, float] = defaultdict(float)
    weights: defaultdict[str, float] = defaultdict(float)
    events = [event for event in json.loads(profile.read_text()) if event.get("cat") == "Node"]
    events = [event for event in events if event["name"].endswith("_kernel_time")]
    if not events or len(events) % runs:
        found = f"{len(events)} nodes in {runs} runs"
        raise InvalidInputError(f"profile {profile}", found, "as many nodes in each run")
    each = len(events) // runs
    counted = events[each:] or events
    share = each / len(counted)
    by_name, part = _by_name(model), FIELD
    for event in counted:
        # what the runtime has put between two nodes belongs to the one before it
        part = by_name(event["name"].removesuffix("_kernel_time")) or part
        seconds[part] += event["dur"] * 1e-6 * share
        flops[part] += _flops(event["args"]) * share
        weights[part] += float(event["args"].get("parameter_size", 0)) * share
    crossing = _crossing(model)
    all_parts = []
    for name in sorted(seconds, key=_ORDER.index):
        moved = weights[name] + crossing[name]
        floor = max(flops[name] / machine.flops_per_s, moved / machine.bytes_per_s)
        all_parts.append(Part(name, seconds[name], flops[name], moved, floor))
    return all_parts


def lines(parts: Sequence[Part]) -> list[str]:
    """A table of the parts for people, with their sum."""
    width = max(len(part.name) for part in parts)
    rows = [f"{'part':<{width}} {'ms':>9} {'GFLOP':>8} {'MB':>8} {'floor, ms':>10} {'ratio':>6}"]
    keys = ("seconds", "flops", "bytes", "floor_s")
    total = Part("all", *(sum(getattr(part, key) for part in parts) for key in keys))
    for part in [*parts, total]:
        ratio = part.seconds / part.floor_s if part.floor_s else math.inf
        rows.append(
            f"{part.name:<{width}} {1e3 * part.seconds:>9.1f} {part.flops / 1e9:>8.2f} {part.bytes / 1e6:>8.1f} "
            f"{1e3 * part.floor_s:>10.1f} {ratio:>6.2f}"
        )
    return rows


def _part(name: str) -> str:
    return next((part for prefix, part in _PARTS if name.startswith(prefix)), "")


def _by_name(model: bytes) -> Callable[[str], str]:
    """Part of a node by its name; what the graph does itself is the field's before the decoder, and answers behind.

    A convolution that the runtime has laid out anew is named after its result. Of other names nothing is known.
    """
    graph = onnx.load_from_string(model).graph
    last = max((number for number, node in enumerate(graph.node) if node.name.startswith("decoder")), default=-1)
    known: dict[str, str] = {}
    for number, node in enumerate(graph.node):
        part = _part(node.name) or (OTHER if number > last else FIELD)
        known |= {node.name: part} | {f"{name}_nchwc": part for name in node.output}
    return lambda name: known.get(name, "")


def _crossing(model: bytes) -> Mapping[str, float]:
    """Bytes that each part takes from others or gives to them."""
    whole = onnx.load_from_string(model)
    graph, by_name = whole.graph, _by_name(model)
    shapes = {
        value.name: [size.dim_value for size in value.type.tensor_type.shape.dim]
        for value in [*graph.value_info, *graph.input, *graph.output]
    }
    bytes_of = {
        value.name: math.prod(shapes[value.name]) * (1 if value.type.tensor_type.elem_type in (2, 3) else _BYTES)
        for value in [*graph.value_info, *graph.input, *graph.output]
    }
    made = {name: by_name(node.name) for node in graph.node for name in node.output}
    constants = {held.name for held in graph.initializer}
    taken: dict[str, set[str]] = defaultdict(set)
    for node in graph.node:
        for name in node.input:
            if name not in constants and made.get(name) != by_name(node.name):
                taken[by_name(node.name)].add(name)
    total: dict[str, float] = defaultdict(float)
    given = set[str]()
    for part, names in taken.items():
        total[part] += sum(bytes_of.get(name, 0) for name in names)
        given |= names
    for name in given & made.keys():
        total[made[name]] += bytes_of.get(name, 0)
    return total


def _flops(arguments: Mapping[str, Any]) -> float:
    """Return the flops of a product or convolution, by the shapes that the runtime notes; 0 for all other operators."""
    shapes = [next(iter(entry.values())) for entry in arguments.get("input_type_shape", [])]
    out = [next(iter(entry.values())) for entry in arguments.get("output_type_shape", [])]
    operator = arguments.get("op_name", "")
    if not out or len(shapes) < 2:
        return 0.0
    if "MatMul" in operator or "Gemm" in operator:
        inner = shapes[0][-1] if shapes[0] else 1
        return 2.0 * float(math.prod(out[0]) * inner)
    if "Conv" in operator:
        return 2.0 * float(math.prod(out[0]) * math.prod(shapes[1][1:]))
    return 0.0
