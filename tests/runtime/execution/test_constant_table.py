"""Tables built into a graph: fewer inputs, the same answers."""

from __future__ import annotations

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from lightpage.errors import BundleError
from runtime.execution.constant_table import GraphFile
from runtime.execution.session import Port, open_session
from tests.runtime import toy

FRAMES = {"in_phase", "quadrature"}


def names_of(model: bytes) -> set[str]:
    return {node.name for node in onnx.load_from_string(model).graph.input}


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
    built = GraphFile(model, "graph").built_in(table, fed)
    assert names_of(built) == FRAMES | set(fed)
    still_fed = {name: value for name, value in table.items() if name in fed}
    answers = open_session(built, "built in", 1).run(["p", "phase"], {**frames, **still_fed})
    expected = open_session(model, "fed", 1).run(["p", "phase"], {**frames, **table})
    for answer, want in zip(answers, expected, strict=True):
        np.testing.assert_array_equal(answer, want)


def test_defaults_that_are_kept_number_by_number_are_replaced_too() -> None:
    """Not every exporter writes raw bytes."""
    default = helper.make_tensor("gain", TensorProto.FLOAT, [2], [1.0, 2.0])
    assert default.float_data
    inputs = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [2]) for name in ("x", "gain")]
    output = helper.make_tensor_value_info("y", TensorProto.FLOAT, [2])
    graph = helper.make_graph([helper.make_node("Mul", ["x", "gain"], ["y"])], "g", inputs, [output], [default])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=9)
    built = GraphFile(model.SerializeToString(), "graph").built_in({"gain": np.array([3, 5], np.float32)}, ())
    (answer,) = open_session(built, "built in", 1).run(["y"], {"x": np.ones(2, np.float32)})
    assert answer.tolist() == [3, 5]


def test_weights_that_an_old_graph_lists_as_inputs_are_no_table() -> None:
    model = onnx.load_from_string(toy.decoder_onnx())
    model.ir_version = 3
    graph = GraphFile(model.SerializeToString(), "graph")
    assert graph.table_inputs == {}
    assert names_of(graph.built_in({}, ())) == FRAMES | set(toy.TABLE_INPUTS)


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
