"""Graphs cut behind what follows from their table: fewer inputs, the same answers."""

import numpy as np
import onnx
import onnx.parser
import pytest
from onnx import helper

from lightpage.errors import BundleError
from lightpage.runtime.model.execution.session import open_session
from lightpage.runtime.model.execution.table_graph import GraphFile, TableGraph
from tests.runtime import toy

FRAMES = {"in_phase", "quadrature"}


@pytest.mark.parametrize("fed", [(), ("homodyne",)])
def test_a_graph_with_its_table_built_in_answers_as_one_that_is_fed(fed: tuple[str, ...]) -> None:
    pair = toy.ToyDevice().page(toy.symbols_of(256, 1)[0], 256)
    frames = {"in_phase": pair.in_phase, "quadrature": pair.quadrature}
    table = {"homodyne": np.array([3.0, 0.7], np.float32), "reference_in_phase": np.full(toy.SHAPE, 120, np.float32)}
    model = toy.decoder_onnx()
    graph = TableGraph(GraphFile(model, "graph"), "graph", fed, 1, table)
    assert graph.inputs.keys() == FRAMES
    found = graph.run(["p", "phase"], frames)
    expected = open_session(model, "fed", 1).run(["p", "phase"], {**frames, **table})
    for answer, want in zip(found, expected, strict=True):
        np.testing.assert_array_equal(answer, want)


def small_graph(body: str, outputs: str = "float[2] y") -> bytes:
    """y of x and a table of gain, 2, and offset, 1, with a constant 10."""
    text = f"""<ir_version: 9, opset_import: ["" : 20]>
        g (float[2] x, float[2] gain = {{2, 2}}, float[2] offset = {{1, 1}}) => ({outputs})
        <float[2] ten = {{10, 10}}> {{ {body} }}"""
    return bytes(onnx.parser.parse_model(text).SerializeToString())


X = np.ones(2, np.float32)
THREE = {"gain": np.full(2, 3, np.float32)}


def table_graph(model: bytes) -> TableGraph:
    return TableGraph(GraphFile(model, "graph"), "graph", (), 1)


def test_what_follows_from_the_table_is_computed_before_the_first_page() -> None:
    model = small_graph("""
        less = Neg(ten)
        made = Mul(gain, less)
        scaled = Mul(x, made)
        shifted = Add(scaled, less)
        y = Add(shifted, offset)""")  # `less` is of no table, and wanted on either side
    cut = GraphFile(model, "graph").cut({}, ())
    assert cut.before is not None
    assert (cut.between, cut.direct) == (("made",), ("offset",))
    assert {node.output[0] for node in onnx.load_from_string(cut.before).graph.node} == {"less", "made"}
    assert "made" not in {node.output[0] for node in cut.behind.graph.node}
    graph = table_graph(model)
    assert graph.run(["y"], {"x": X})[0].tolist() == [-29, -29]
    other = graph.with_table(THREE)
    assert other.run(["y"], {"x": X})[0].tolist() == [-39, -39]
    assert other.session is graph.session  # only what follows from the table was made anew
    assert graph.run(["y"], {"x": X})[0].tolist() == [-29, -29]


def test_an_output_may_follow_from_the_table_alone() -> None:
    graph = table_graph(small_graph("less = Neg(gain) y = Mul(x, less)", "float[2] y, float[2] less"))
    assert graph.with_table(THREE).run(["y"], {"x": X})[0].tolist() == [-3, -3]


def test_a_graph_with_others_inside_is_not_cut() -> None:
    """They may use any tensor around them without saying so."""
    inner = "inner () => (float[2] inside) { inside = Neg(made) }"
    graph = table_graph(
        small_graph(f"""
        made = Mul(gain, ten)
        most = ReduceMax<keepdims = 0>(x)
        flag = Cast<to = 9>(most)
        y = If(flag) <then_branch = {inner}, else_branch = {inner}>""")
    )
    assert graph.with_table(THREE).run(["y"], {"x": X})[0].tolist() == [-30, -30]


def test_weights_that_an_old_graph_lists_as_inputs_are_no_table() -> None:
    model = onnx.load_from_string(toy.decoder_onnx())
    model.ir_version = 3
    graph = GraphFile(model.SerializeToString(), "graph")
    assert graph.table_inputs == {}
    assert TableGraph(graph, "graph", (), 1).inputs.keys() == FRAMES


@pytest.mark.parametrize("raw", [True, False])
@pytest.mark.parametrize("dtype", ["int64", "uint8"])
def test_a_default_is_what_the_graph_holds_however_it_is_kept_and_can_be_replaced(dtype: str, raw: bool) -> None:
    values = np.arange(6).reshape(2, 3).astype(dtype)
    kind = helper.np_dtype_to_tensor_dtype(values.dtype)
    default = helper.make_tensor("gain", kind, values.shape, values.tobytes() if raw else values.ravel(), raw=raw)
    inputs = [helper.make_tensor_value_info(name, kind, values.shape) for name in ("x", "gain")]
    output = helper.make_tensor_value_info("y", kind, values.shape)
    graph = helper.make_graph([helper.make_node("Mul", ["x", "gain"], ["y"])], "g", inputs, [output], [default])
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=9)
    found = GraphFile(made.SerializeToString(), "graph").default("gain")
    assert found.dtype == values.dtype
    np.testing.assert_array_equal(found, values)
    other = table_graph(made.SerializeToString()).with_table({"gain": values + 1})
    np.testing.assert_array_equal(other.run(["y"], {"x": values})[0], values * (values + 1))


@pytest.mark.parametrize("model", [b"", toy.decoder_onnx()[:1000]])
def test_bytes_that_are_no_model_are_refused(model: bytes) -> None:
    with pytest.raises(BundleError, match=r"^decoder\.onnx"):
        GraphFile(model, "decoder.onnx")
