"""Cost of a graph for batches on a GPU, and the nodes that would be slow there, counted without one."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import onnx
from onnx import TensorProto, helper, shape_inference

from lightpage.export.batched import PAGES
from lightpage.export.graph import FRAME_INPUTS
from lightpage.runtime.model.decoding.batch_graph import SHIFT

_FREE = frozenset(["Reshape", "Squeeze", "Unsqueeze", "Flatten", "Identity", "Constant", "Shape"])
"""Operators that move nothing."""
_PLANE = 24
"""Rows and columns from which on a tensor is a plane, or many."""


@dataclass(frozen=True)
class Cost:
    """Cost of a batch.

    Attributes:
        kernels: kernels that are launched for it.
        bytes_a_page: bytes that they read and write, each for itself; constants are shared by the pages.
        flops_a_page: operations of products and convolutions.
        by_operator: bytes a page of each operator, the most first.
    """

    kernels: int
    bytes_a_page: float
    flops_a_page: float
    by_operator: dict[str, float]


class BatchFile:
    """A graph for batches of so many pages.

    Args:
        model: serialised, as `lightpage.export.batched.batched_onnx` makes the second one.
        pages: number of pages of a batch.
    """

    def __init__(self, model: bytes, pages: int) -> None:
        whole = onnx.load_from_string(model)
        for value in (*whole.graph.input, *whole.graph.output):
            for axis in value.type.tensor_type.shape.dim:
                if axis.dim_param == PAGES:
                    axis.dim_value = pages
        self.pages, self.model = pages, shape_inference.infer_shapes(whole, data_prop=True)
        graph = self.model.graph
        self._types: dict[str, tuple[int, tuple[int, ...]]] = {}
        for value in (*graph.value_info, *graph.input, *graph.output):
            kind = value.type.tensor_type
            self._types[value.name] = kind.elem_type, tuple(axis.dim_value for axis in kind.shape.dim)
        for tensor in graph.initializer:
            self._types[tensor.name] = tensor.data_type, tuple(tensor.dims)
        self.varying = {*FRAME_INPUTS, SHIFT}
        """Tensors that differ from page to page."""
        for node in graph.node:
            if node.op_type != "Shape" and self.varying.intersection(node.input):
                self.varying.update(node.output)
        self._users = Counter(name for node in graph.node for name in node.input)

    def cost(self) -> Cost:
        """Return the cost of a batch."""
        kernels, flops, moved = 0, 0.0, dict[str, float]()
        for node in self._running():
            kernels += 1
            names = [name for name in (*node.input, *node.output) if name]
            moved[node.op_type] = moved.get(node.op_type, 0.0) + sum(map(self._bytes, names)) / self.pages
            flops += self._flops(node) / self.pages
        ordered = dict(sorted(moved.items(), key=lambda each: -each[1]))
        return Cost(kernels, sum(moved.values()), flops, ordered)

    def left_constants(self) -> list[str]:
        """Products whose left factor is a constant and whose right one is many pages, by name."""
        products = (node for node in self.model.graph.node if node.op_type == "MatMul")
        return [node.name for node in products if node.input[0] not in self.varying and node.input[1] in self.varying]

    def reduced_planes(self) -> list[str]:
        """Sums and means over planes, by name."""
        nodes = (node for node in self.model.graph.node if node.op_type.startswith("Reduce"))
        return [node.name for node in nodes if node.input[0] in self.varying and self._is_plane(node.input[0])]

    def rounded_places(self) -> list[str]:
        """Nodes that sample at places that went through a product or a convolution, by name: it may be rounded."""
        rounded: set[str] = set()
        for node in self.model.graph.node:
            if node.op_type in ("MatMul", "Gemm", "Conv") or rounded.intersection(node.input):
                rounded.update(node.output)
        nodes = (node for node in self.model.graph.node if node.op_type == "GridSample")
        return [node.name for node in nodes if node.input[1] in rounded]

    def wide_planes(self, page_shape: tuple[int, int]) -> list[str]:
        """Planes in float32 that neither go into the sampling nor come from it, by name.

        Args:
            page_shape: shape of p, which is float32.
        """
        sampled = {name for node in self.model.graph.node if node.op_type == "GridSample" for name in node.output}
        around = sampled | {
            name for node in self.model.graph.node if node.op_type == "GridSample" for name in node.input[:2]
        }
        for node in reversed(self.model.graph.node):  # views of what is sampled
            if node.op_type in _FREE and around.intersection(node.output):
                around.add(node.input[0])
        for node in self.model.graph.node:  # and of what comes of it
            if node.op_type in (*_FREE, "Gather") and sampled.intersection(node.input[:1]):
                sampled.update(node.output)
        found = []
        for name in sorted(self.varying - around - sampled):
            kind, shape = self._types.get(name, (0, ()))
            if kind == TensorProto.FLOAT and self._is_plane(name) and shape[-2:] != page_shape:
                found.append(name)
        return found

    def _running(self) -> Iterator[onnx.NodeProto]:
        """Nodes that a batch launches: no views, and no transpose that a product takes with its factor."""
        products = {name for node in self.model.graph.node if node.op_type == "MatMul" for name in node.input}
        for node in self.model.graph.node:
            if node.op_type in _FREE or not self.varying.intersection(node.input):
                continue
            if node.op_type == "Transpose" and node.output[0] in products and self._users[node.output[0]] == 1:
                (order,) = (list(attribute.ints) for attribute in node.attribute)
                if order[:-2] == list(range(len(order) - 2)):
                    continue
            yield node

    def _bytes(self, name: str) -> float:
        kind, shape = self._types.get(name, (TensorProto.FLOAT, ()))
        return math.prod(shape) * np.dtype(helper.tensor_dtype_to_np_dtype(kind)).itemsize

    def _flops(self, node: onnx.NodeProto) -> float:
        out = math.prod(self._types[node.output[0]][1])
        if node.op_type == "MatMul":
            return 2.0 * out * self._types[node.input[0]][1][-1]
        if node.op_type == "Conv":
            return 2.0 * out * math.prod(self._types[node.input[1]][1][1:])
        return 0.0

    def _is_plane(self, name: str) -> bool:
        shape = self._types.get(name, (0, ()))[1]
        return len(shape) > 1 and min(shape[-2:]) >= _PLANE
