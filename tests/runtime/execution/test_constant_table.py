"""Graphs cut behind what follows from their table: fewer inputs, the same answers."""

from __future__ import annotations

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from lightpage.calibration.sampling_table import SamplingTable
from lightpage.errors import BundleError
from runtime.execution.constant_table import GraphFile
from runtime.execution.session import Port, open_session
from runtime.execution.table_graph import TableGraph
from tests.runtime import toy

FRAMES = {"in_phase", "quadrature"}


def answers(
    model: bytes, outputs: list[str], table: SamplingTable, fed: tuple[str, ...], **frames: np.ndarray
) -> list[np.ndarray]:
    """Of a graph that is given all of its table but what is fed."""
    return TableGraph(GraphFile(model, "graph"), "graph", fed, 1, table).run(outputs, frames)


def test_table_inputs_are_listed_with_type_and_shape() -> None:
    assert GraphFile(toy.decoder_onnx(), "graph").table_inputs == {
        "reference_in_phase": Port("float32", toy.SHAPE),
        "reference_quadrature": Port("float32", toy.SHAPE),
        "homodyne": Port("float32", (2,)),
    }


@pytest.mark.parametrize("fed", [(), ("homodyne",)])
def test_a_graph_with_its_table_built_in_answers_as_one_that_is_fed(fed: tuple[str, ...]) -> None:
    device = toy.ToyDevice()
    pair = device.page(toy.symbols_of(256, 1)[0], 256)
    frames = {"in_phase": pair.in_phase, "quadrature": pair.quadrature}
    table = {"homodyne": np.array([3.0, 0.7], np.float32), "reference_in_phase": np.full(toy.SHAPE, 120, np.float32)}
    model = toy.decoder_onnx()
    graph = TableGraph(GraphFile(model, "graph"), "graph", fed, 1, table)
    assert graph.inputs.keys() == FRAMES
    found = graph.run(["p", "phase"], frames)
    expected = open_session(model, "fed", 1).run(["p", "phase"], {**frames, **table})
    for answer, want in zip(found, expected, strict=True):
        np.testing.assert_array_equal(answer, want)


def test_defaults_that_are_kept_number_by_number_are_replaced_too() -> None:
    """Not every exporter writes raw bytes."""
    default = helper.make_tensor("gain", TensorProto.FLOAT, [2], [1.0, 2.0])
    assert default.float_data
    inputs = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [2]) for name in ("x", "gain")]
    output = helper.make_tensor_value_info("y", TensorProto.FLOAT, [2])
    graph = helper.make_graph([helper.make_node("Mul", ["x", "gain"], ["y"])], "g", inputs, [output], [default])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=9)
    table = {"gain": np.array([3, 5], np.float32)}
    (answer,) = answers(model.SerializeToString(), ["y"], table, (), x=np.ones(2, np.float32))
    assert answer.tolist() == [3, 5]


def small_graph(nodes: list[onnx.NodeProto], outputs: tuple[str, ...] = ("y",)) -> bytes:
    """y of x and a table of gain, 2, and offset, 1, with a constant 10."""
    inputs = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [2]) for name in ("x", "gain", "offset")]
    made = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [2]) for name in outputs]
    held = {"gain": 2.0, "offset": 1.0, "ten": 10.0}
    constants = [helper.make_tensor(name, TensorProto.FLOAT, [2], [value] * 2) for name, value in held.items()]
    graph = helper.make_graph(nodes, "g", inputs, made, constants)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=9).SerializeToString()


X = np.ones(2, np.float32)
THREE = {"gain": np.full(2, 3, np.float32)}


def test_what_follows_from_the_table_is_computed_before_the_first_page() -> None:
    nodes = [
        helper.make_node("Neg", ["ten"], ["less"]),  # of no table, wanted on either side
        helper.make_node("Mul", ["gain", "less"], ["made"]),
        helper.make_node("Mul", ["x", "made"], ["scaled"]),
        helper.make_node("Add", ["scaled", "less"], ["shifted"]),
        helper.make_node("Add", ["shifted", "offset"], ["y"]),
    ]
    cut = GraphFile(small_graph(nodes), "graph").cut({}, ())
    assert cut.before is not None
    assert (cut.between, cut.direct) == (("made",), ("offset",))
    assert {node.output[0] for node in onnx.load_from_string(cut.before).graph.node} == {"less", "made"}
    assert "made" not in {node.output[0] for node in cut.behind.graph.node}
    graph = TableGraph(GraphFile(small_graph(nodes), "graph"), "graph", (), 1)
    assert graph.run(["y"], {"x": X})[0].tolist() == [-29, -29]
    other = graph.with_table(THREE)
    assert other.run(["y"], {"x": X})[0].tolist() == [-39, -39]
    assert other.session is graph.session  # only what follows from the table was made anew
    assert graph.run(["y"], {"x": X})[0].tolist() == [-29, -29]


def test_an_output_may_follow_from_the_table_alone() -> None:
    nodes = [helper.make_node("Neg", ["gain"], ["less"]), helper.make_node("Mul", ["x", "less"], ["y"])]
    found = answers(small_graph(nodes, ("y", "less")), ["y"], THREE, (), x=X)
    assert found[0].tolist() == [-3, -3]


def test_a_graph_with_others_inside_is_not_cut() -> None:
    """They may use any tensor around them without saying so."""
    inner = helper.make_graph(
        [helper.make_node("Neg", ["made"], ["inside"])],
        "inner",
        [],
        [helper.make_tensor_value_info("inside", TensorProto.FLOAT, [2])],
    )
    nodes = [
        helper.make_node("Mul", ["gain", "ten"], ["made"]),
        helper.make_node("Cast", ["x"], ["flags"], to=TensorProto.BOOL),
        helper.make_node("ReduceMax", ["x"], ["most"], keepdims=0),
        helper.make_node("Cast", ["most"], ["flag"], to=TensorProto.BOOL),
        helper.make_node("If", ["flag"], ["y"], then_branch=inner, else_branch=inner),
    ]
    graph = TableGraph(GraphFile(small_graph(nodes), "graph"), "graph", (), 1)
    assert graph.run(["y"], {"x": X})[0].tolist() == [-20, -20]
    assert graph.with_table(THREE).run(["y"], {"x": X})[0].tolist() == [-30, -30]


def test_weights_that_an_old_graph_lists_as_inputs_are_no_table() -> None:
    model = onnx.load_from_string(toy.decoder_onnx())
    model.ir_version = 3
    graph = GraphFile(model.SerializeToString(), "graph")
    assert graph.table_inputs == {}
    assert TableGraph(graph, "graph", (), 1).inputs.keys() == FRAMES


@pytest.mark.parametrize("raw", [True, False])
@pytest.mark.parametrize("dtype", ["float32", "float64", "int32", "int64", "uint8"])
def test_a_default_is_what_the_graph_holds(dtype: str, raw: bool) -> None:
    values = np.arange(6).reshape(2, 3).astype(dtype)
    kind = helper.np_dtype_to_tensor_dtype(values.dtype)
    data = values.tobytes() if raw else values.ravel()
    default = helper.make_tensor("gain", kind, values.shape, data, raw=raw)
    inputs = [helper.make_tensor_value_info(name, kind, values.shape) for name in ("x", "gain")]
    output = helper.make_tensor_value_info("y", kind, values.shape)
    graph = helper.make_graph([helper.make_node("Add", ["x", "gain"], ["y"])], "g", inputs, [output], [default])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=9)
    found = GraphFile(model.SerializeToString(), "graph").default("gain")
    assert found.dtype == values.dtype
    np.testing.assert_array_equal(found, values)


@pytest.mark.parametrize("model", [b"", b"no model", toy.decoder_onnx()[:1000]])
def test_bytes_that_are_no_model_are_refused(model: bytes) -> None:
    with pytest.raises(BundleError, match=r"decoder\.onnx.*wanted an ONNX model"):
        GraphFile(model, "decoder.onnx")
