"""Estimate of a page's time on a GPU, by its data sheet, where no GPU can be measured.

    python -m analysis.speed.roofline --profile paper --decoder fast --decoder coherent --decoder refined

Flops and bytes of every node that runs for a page, by kind. A node takes the longer of its flops at the peak and of its
bytes, all that it reads and writes, at the memory's bandwidth; both at a share of what the data sheet says. To that
come the launches of all nodes, and the frames over the bus. At best all three overlap, page behind page: the longest
of them bounds the rate. What the host does behind the graph is not counted.
"""

from __future__ import annotations

import math
import sys
from collections import defaultdict
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import click
import onnx
from onnx import helper, shape_inference

from analysis.speed.untrained_graphs import makers_of
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.device.profile import Profile, load_profile
from lightpage.export.graph import FRAME_INPUTS
from lightpage.export.half import PRECISIONS, in_half
from lightpage.export.onnx_files import decoder_onnx
from lightpage.export.operators.check import page_part
from lightpage.metrics.provenance import write_figures
from lightpage.runtime.model.bundle.manifest import FLOAT16
from lightpage.runtime.model.execution.page_graph import PAGE_INPUTS

CONVOLUTIONS, PRODUCTS, SAMPLING, LAYOUT, POINTWISE = (
    "convolutions",
    "matrix products",
    "sampling",
    "layout",
    "pointwise",
)
_KINDS = {
    "Conv": CONVOLUTIONS,
    **dict.fromkeys(("MatMul", "Gemm"), PRODUCTS),
    "GridSample": SAMPLING,
    **dict.fromkeys(("Concat", "Gather", "GatherND", "Pad", "Slice", "Split", "Transpose"), LAYOUT),
}
"""Kinds of operators; all others work number by number, or sum."""
_DECODERS = "As `analysis.speed.speed` names it: wave is the preset standard, refined is accurate."
_FREE = frozenset(["Constant", "Flatten", "Identity", "Reshape", "Squeeze", "Unsqueeze"])
"""Operators that move nothing."""


@dataclass(frozen=True)
class Gpu:
    """A data sheet: peaks of products in each precision, and of the memory.

    Attributes:
        name: name of the GPU.
        flops_per_s: dense, by precision; float32 without the rounding of tensor cores.
        half_flops_per_s: peak of float16 on tensor cores.
        bytes_per_s: bandwidth of its memory.
        bus_bytes_per_s: bandwidth from the host.
        launch_s: time from one kernel to the next.
    """

    name: str
    flops_per_s: float
    half_flops_per_s: float
    bytes_per_s: float
    bus_bytes_per_s: float
    launch_s: float


H100 = Gpu("H100 SXM", 67e12, 989e12, 3.35e12, 55e9, 4e-6)
"""Figures of NVIDIA's data sheet; bus and launches as commonly measured."""


@dataclass(frozen=True)
class Load:
    """Load of all nodes of a kind, for a page.

    Attributes:
        nodes: how many.
        flops: operations of products and convolutions, in float32 and float16 together.
        bytes: read and written.
        seconds: seconds on the GPU.
    """

    nodes: int
    flops: float
    bytes: float
    seconds: float


def loads(decoder: bytes, gpu: Gpu, share: float) -> dict[str, Load]:
    """Return the load of a page, by kind of node.

    Args:
        decoder: decoder.onnx.
        gpu: GPU that it would run on.
        share: share of the peaks that is reached.
    """
    model = shape_inference.infer_shapes(onnx.load_from_string(page_part(decoder)), data_prop=True)
    graph = model.graph
    values = {value.name: value for value in (*graph.value_info, *graph.input, *graph.output)}
    shapes: dict[str, list[int]] = {tensor.name: list(tensor.dims) for tensor in graph.initializer}
    sizes = {tensor.name: _itemsize(tensor.data_type) for tensor in graph.initializer}
    for name, value in values.items():
        described = value.type.tensor_type
        shapes[name] = [axis.dim_value for axis in described.shape.dim]
        sizes[name] = _itemsize(described.elem_type)
    found: dict[str, list[tuple[float, float, float]]] = defaultdict(list)
    for node in graph.node:
        if node.op_type in _FREE or not any(name in values for name in (*node.input, *node.output)):
            continue
        moved = sum(
            math.prod(shapes.get(name, [])) * sizes.get(name, 0) for name in (*node.input, *node.output) if name
        )
        flops = _flops(node, shapes)
        peak = gpu.half_flops_per_s if sizes.get(node.output[0]) == 2 else gpu.flops_per_s
        seconds = max(flops / (share * peak), moved / (share * gpu.bytes_per_s))
        found[_KINDS.get(node.op_type, POINTWISE)].append((flops, float(moved), seconds))
    return {
        kind: Load(len(nodes), *(math.fsum(column) for column in zip(*nodes, strict=True)))
        for kind, nodes in sorted(found.items())
    }


def estimate(by_kind: dict[str, Load], frame_bytes: int, gpu: Gpu) -> dict[str, float]:
    """Seconds a page on the GPU: the work, the launches, the frames over the bus; and pages a second at best.

    Args:
        by_kind: see `loads`.
        frame_bytes: bytes of both frames.
        gpu: the same.
    """
    work = math.fsum(load.seconds for load in by_kind.values())
    launches = gpu.launch_s * sum(load.nodes for load in by_kind.values())
    bus = frame_bytes / gpu.bus_bytes_per_s
    rate = 1 / max(work, launches, bus)
    return {
        "work_s": work,
        "launches_s": launches,
        "bus_s": bus,
        "pages_per_s": rate,
        "bytes_per_s": rate * frame_bytes,
    }


def _itemsize(element: int) -> int:
    return int(helper.tensor_dtype_to_np_dtype(element).itemsize) if element else 0


def _flops(node: onnx.NodeProto, shapes: dict[str, list[int]]) -> float:
    """Two for a multiplication with an addition; 0 for all but products and convolutions."""
    out = math.prod(shapes.get(node.output[0], []))
    if node.op_type in ("MatMul", "Gemm"):
        return 2.0 * out * (shapes.get(node.input[0]) or [1])[-1]
    if node.op_type == "Conv":
        return 2.0 * out * math.prod(shapes.get(node.input[1], [0])[1:])
    return 0.0


def exported(profile: Profile, name: str, precision: str, known: dict[str, Callable[[], Any]]) -> bytes:
    """An untrained decoder as ONNX."""
    graph, tensors = known[name]()
    model = decoder_onnx(graph.eval(), "uint8", profile.frame_shape, tensors)
    return in_half(model, PAGE_INPUTS) if precision == FLOAT16 else model


@click.command()
@click.option("--profile", "profile_name", default="paper", show_default=True, help="Shipped profile or TOML file.")
@click.option("--decoder", "names", multiple=True, default=("refined",), show_default=True, help=_DECODERS)
@click.option("--precision", "precisions", multiple=True, type=click.Choice(PRECISIONS), default=PRECISIONS)
@click.option(
    "--share", type=click.FloatRange(0.01, 1), default=0.4, show_default=True, help="Share of the peaks reached."
)
@click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file.")
def main(
    profile_name: str, names: tuple[str, ...], precisions: tuple[str, ...], share: float, json_path: Path | None
) -> None:
    """Print flops and bytes a page by kind, and what a data sheet makes of them. Nothing is run: an estimate."""
    profile = load_profile(profile_name)
    known = makers_of(profile, names)
    frame_bytes = len(FRAME_INPUTS) * math.prod(profile.frame_shape)
    click.echo(f"estimate, nothing was run: {H100.name} at {share:.0%} of its data sheet, profile {profile.name}")
    figures: dict[str, Any] = {"profile": profile.name, "gpu": asdict(H100), "share": share, "estimate": True}
    for name in dict.fromkeys(names):
        for precision in dict.fromkeys(precisions):
            by_kind = loads(exported(profile, name, precision, known), H100, share)
            expected = estimate(by_kind, frame_bytes, H100)
            click.echo(f"\n{name}, {precision}\n{'kind':<16} {'nodes':>6} {'GFLOP':>8} {'MB':>8} {'ms':>8}")
            for kind, load in by_kind.items():
                click.echo(
                    f"{kind:<16} {load.nodes:>6} {load.flops / 1e9:>8.1f} {load.bytes / 1e6:>8.0f} "
                    f"{1e3 * load.seconds:>8.2f}"
                )
            click.echo(
                f"work {1e3 * expected['work_s']:.1f} ms, launches {1e3 * expected['launches_s']:.1f} ms, frames over "
                f"the bus {1e3 * expected['bus_s']:.1f} ms: {expected['pages_per_s']:.0f} pages/s, "
                f"{expected['bytes_per_s'] / 1e9:.1f} GB/s of frames"
            )
            kinds = {kind: asdict(load) for kind, load in by_kind.items()}
            figures.setdefault("decoders", {}).setdefault(name, {})[precision] = {"kinds": kinds, **expected}
    if json_path is not None:
        write_figures(json_path, figures)


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.speed.roofline"))
