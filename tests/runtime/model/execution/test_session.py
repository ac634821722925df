"""Sessions of one process share their memory."""

import os
from pathlib import Path

import numpy as np
import onnx

from lightpage.runtime.model.execution.session import Session, open_session

VALUES = 32_000_000


def graph_of_many_values() -> bytes:
    """A graph that adds a number to itself in a long vector, and sums it."""
    number = onnx.helper.make_tensor_value_info("number", onnx.TensorProto.FLOAT, [1])
    total = onnx.helper.make_tensor_value_info("total", onnx.TensorProto.FLOAT, [1])
    size = onnx.numpy_helper.from_array(np.array([VALUES], np.int64), "size")
    nodes = [
        onnx.helper.make_node("Expand", ["number", "size"], ["vector"]),
        onnx.helper.make_node("Add", ["vector", "vector"], ["doubled"]),
        onnx.helper.make_node("ReduceSum", ["doubled"], ["total"], keepdims=1),
    ]
    graph = onnx.helper.make_graph(nodes, "doubling", [number], [total], [size])
    opset = onnx.helper.make_opsetid("", 18)
    return bytes(onnx.helper.make_model(graph, ir_version=10, opset_imports=[opset]).SerializeToString())


def resident_bytes() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def run(session: Session) -> None:
    session.run(None, {"number": np.ones(1, np.float32)})


def test_a_session_uses_the_memory_that_another_has_freed() -> None:
    first, second = (open_session(graph_of_many_values(), "graph", 1) for _ in range(2))
    run(first)
    before = resident_bytes()
    run(second)
    assert resident_bytes() - before < VALUES  # of 8 bytes a value that a run takes
