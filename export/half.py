"""A decoder in half precision: network and waves in float16, what recovers the field in float32.

The field's recovery stays as it is, since frames hold counts up to 65,535. So does the sampling: CUDA samples in
float32 alone. So does the last step to p, which grows with the light beyond what float16 holds. And so does the pipe on
the way to the cameras, whose accumulated rounding alone changes p by 1%.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, shape_inference

from lightpage.errors import BundleError, InvalidInputError
from lightpage.export.graph import FRAME_INPUTS
from lightpage.runtime.model.bundle.manifest import FLOAT16, FLOAT32, Precision

PRECISIONS: tuple[Precision, ...] = (FLOAT32, FLOAT16)
LARGEST_DEVIATION = 1e-2
"""Of p, over its length, that the 99th percentile of a page's symbols may have in half precision."""
_PERCENTILE = 99
_IN_FLOAT16 = re.compile(r"decoder/(network/\w+/|refiners/\d+/unet/\w+/|prediction/(back/|waves/(?!_pipe/)))")
"""Beginnings of the names of nodes that are computed in float16."""
_IN_FLOAT32 = frozenset(["Resize"])
"""Operators that take sizes as float32, whatever their data are."""


def in_half(model: bytes, fed: Collection[str]) -> bytes:
    """A decoder.onnx with the same inputs and outputs, network and waves in float16.

    What follows from the table alone is computed once, in float32, and rounded.

    Args:
        model: serialised, its nodes named after the modules that they come from (`lightpage.export.onnx_files`).
        fed: table inputs that may differ from page to page.

    Raises:
        InvalidInputError: no node belongs to a network.
    """
    graph = _Graph(model, fed)
    casts: dict[tuple[str, int], str] = {}

    def as_type(name: str, element: int) -> str:
        """A tensor in another precision, cast once."""
        if (name, element) not in casts:
            casts[name, element] = f"{name}/{TensorProto.DataType.Name(element).lower()}"
            graph.cast(name, casts[name, element], element)
        return casts[name, element]

    halved: set[str] = set()
    for node, chosen in graph.nodes():
        for number, name in enumerate(node.input):
            if chosen and graph.is_float(name) and name not in halved:
                node.input[number] = as_type(name, TensorProto.FLOAT16)
            elif not chosen and name in halved:
                node.input[number] = as_type(name, TensorProto.FLOAT)
        if chosen:
            halved.update(filter(graph.is_float, node.output))
            for attribute in node.attribute if node.op_type == "Cast" else ():
                if attribute.name == "to" and attribute.i == TensorProto.FLOAT:
                    attribute.i = TensorProto.FLOAT16
        graph.keep(node)
    if not halved:
        raise InvalidInputError("decoder.onnx", "no node of a network", "nodes named after their modules")
    return graph.made(halved)


def rounded(model: bytes, fed: Collection[str]) -> bytes:
    """Return `in_half` in float32 with every number rounded to float16: a CPU shows so what a GPU would do.

    A CPU has few kernels of float16. Its runtime casts around each node, and leaves out two casts that meet, and with
    them most of the rounding. Arguments as for `in_half`. To be opened without optimisations.
    """
    graph = _Graph(model, fed)
    known: dict[str, str] = {}
    halved: set[str] = set()

    def rounding(name: str) -> str:
        """A tensor rounded to float16, once."""
        if name not in known:
            half, known[name] = f"{name}/float16", f"{name}/rounded"
            graph.cast(name, half, TensorProto.FLOAT16)
            graph.cast(half, known[name], TensorProto.FLOAT)
        return known[name]

    for node, chosen in graph.nodes():
        for number, name in enumerate(node.input):
            if (chosen and graph.is_float(name)) or name in halved:
                node.input[number] = rounding(name)
        if chosen:
            halved.update(filter(graph.is_float, node.output))
        graph.keep(node)
    return graph.made(())


class _Graph:
    """A decoder's graph while it is made anew, node by node."""

    def __init__(self, model: bytes, fed: Collection[str]) -> None:
        self._whole = shape_inference.infer_shapes(onnx.load_from_string(model))
        self._fed, graph = fed, self._whole.graph
        described = (*graph.value_info, *graph.input, *graph.output)
        self._types = {value.name: value.type.tensor_type.elem_type for value in described}
        self._types |= {tensor.name: tensor.data_type for tensor in graph.initializer}
        self._made: list[onnx.NodeProto] = []

    def nodes(self) -> Iterator[tuple[onnx.NodeProto, bool]]:
        """A copy of every node, and whether it is to be computed in float16."""
        varying = {*FRAME_INPUTS, *self._fed}
        for node in self._whole.graph.node:
            of_page = not varying.isdisjoint(node.input)
            varying.update(node.output if of_page else ())
            copied = onnx.NodeProto.FromString(node.SerializeToString())
            named = _IN_FLOAT16.match(node.name) is not None
            yield copied, of_page and named and node.op_type not in _IN_FLOAT32

    def is_float(self, name: str) -> bool:
        return self._types.get(name) == TensorProto.FLOAT

    def cast(self, source: str, result: str, element: int) -> None:
        self._made.append(helper.make_node("Cast", [source], [result], result, to=element))

    def keep(self, node: onnx.NodeProto) -> None:
        self._made.append(node)

    def made(self, halved: Collection[str]) -> bytes:
        """The model with the new nodes, some of its tensors in float16."""
        graph = self._whole.graph
        for value in graph.value_info:
            if value.name in halved:
                value.type.tensor_type.elem_type = TensorProto.FLOAT16
        del graph.node[:]
        graph.node.extend(self._made)
        onnx.checker.check_model(self._whole)
        return bytes(self._whole.SerializeToString())


def deviation(expected: NDArray[np.float32], got: NDArray[np.float32]) -> float:
    """Return how far p [2, ny, nx] is off, over its length: the 99th percentile of a page's symbols."""
    length = np.maximum(np.linalg.norm(expected, axis=0), np.finfo(np.float32).tiny)
    return float(np.percentile(np.linalg.norm(got - expected, axis=0) / length, _PERCENTILE))


def check_deviation(expected: NDArray[np.float32], got: NDArray[np.float32], subject: str) -> float:
    """The `deviation` of a decoder in half precision.

    Raises:
        BundleError: it is larger than `LARGEST_DEVIATION`, or not a number.
    """
    found = deviation(expected, got)
    if not found <= LARGEST_DEVIATION:
        got_text = f"p off by {found:.3g} of its length, at the {_PERCENTILE}th percentile"
        raise BundleError(f"parity of {subject} with torch", got_text, f"<= {LARGEST_DEVIATION:g}")
    return found
