"""Graphs as files: a large constant is kept once; what is halved, what stays, and rounding that a CPU shows too."""

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, numpy_helper, parser
from torch import nn

from lightpage.errors import BundleError, InvalidInputError
from lightpage.export.half import check_deviation, in_half, rounded
from lightpage.export.onnx_files import exported
from lightpage.runtime.model.execution.session import open_session

GRAPH = """<ir_version: 10, opset_import: ["" : 20]>
decoder (float[2, 3] in_phase, float[2, 3] quadrature, float[3] gain = {1, 0.3, 2}) => (float[2, 3] p)
{
  field = Sub(in_phase, quadrature)
  third = Constant<value_float = 0.333333>()
  light = Mul(field, gain)
  inner = Mul(light, third)
  outer = Add(inner, light)
  p = Exp(outer)
}"""
NAMES = ("decoder/field", "constant", "decoder/network/stem/a", "decoder/network/stem/b", "decoder/network/head/c", "e")


def graph() -> bytes:
    """A decoder of a few nodes, three of which belong to its network."""
    model = parser.parse_model(GRAPH)
    for node, name in zip(model.graph.node, NAMES, strict=True):
        node.name = name
    return bytes(onnx.shape_inference.infer_shapes(model).SerializeToString())


def feeds() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(5)
    return {name: rng.normal(size=(2, 3)).astype(np.float32) for name in ("in_phase", "quadrature")}


def test_the_network_is_halved_and_inputs_and_outputs_are_not() -> None:
    model = onnx.shape_inference.infer_shapes(onnx.load_from_string(in_half(graph(), ())), strict_mode=True)
    types = {value.name: value.type.tensor_type.elem_type for value in model.graph.value_info}
    halves = {name for name, found in types.items() if found == TensorProto.FLOAT16}
    assert halves == {"light", "inner", "outer", "field/float16", "gain/float16", "third/float16"}
    assert {value.type.tensor_type.elem_type for value in (*model.graph.input, *model.graph.output)} == {1}


def test_rounding_shows_on_a_cpu() -> None:
    exact = open_session(graph(), "exact", 1).run(["p"], feeds())[0]
    halved = open_session(rounded(graph(), ()), "rounded", 1, once=True).run(["p"], feeds())[0]
    field = (feeds()["in_phase"] - feeds()["quadrature"]).astype(np.float16)
    light = (field.astype(np.float32) * np.float16([1, 0.3, 2]).astype(np.float32)).astype(np.float16)
    inner = (light.astype(np.float32) * np.float32(np.float16(0.333333))).astype(np.float16)
    expected = np.exp((inner.astype(np.float32) + light.astype(np.float32)).astype(np.float16).astype(np.float32))
    np.testing.assert_allclose(halved, expected, rtol=1e-6)
    assert np.abs(halved - exact).max() > 1e-5


def test_too_large_a_deviation_is_refused() -> None:
    p = np.ones((2, 4, 5), np.float32)
    assert check_deviation(p, p * np.float32(1.009), "half.zip") == pytest.approx(0.009, abs=1e-5)
    with pytest.raises(BundleError, match=r"0\.011"):
        check_deviation(p, p * np.float32(1.011), "half.zip")
    with pytest.raises(BundleError, match="nan"):
        check_deviation(p, p * np.float32(np.nan), "half.zip")


def test_a_graph_without_a_network_is_refused() -> None:
    model = onnx.load_from_string(graph())
    for node in model.graph.node:
        node.name = node.name.replace("decoder/network", "decoder/net")
    with pytest.raises(InvalidInputError, match=r"^decoder\.onnx"):
        in_half(model.SerializeToString(), ())


class TwoWays(nn.Module):
    """Products with three matrices, two of which are alike."""

    def __init__(self) -> None:
        super().__init__()
        rng = torch.Generator().manual_seed(0)
        large, other = torch.rand(40, 40, generator=rng), torch.rand(40, 40, generator=rng)
        for name, value in (("there", large), ("back", large.clone()), ("other", other)):
            self.register_buffer(name, value)

    def forward(self, light: torch.Tensor) -> torch.Tensor:
        return light @ self.there @ self.other @ self.back


def test_a_large_constant_is_kept_once_and_the_answer_is_the_same() -> None:
    module, light = TwoWays(), torch.eye(40)
    model = exported(module, (light,), ("light",), ("seen",), None)
    onnx.checker.check_model(model)
    held = [numpy_helper.to_array(one) for one in model.graph.initializer if np.prod(one.dims) == 1600]
    assert len(held) == 2
    assert not np.array_equal(*held)
    (seen,) = open_session(model.SerializeToString(), "two ways", 1).run(["seen"], {"light": light.numpy()})
    np.testing.assert_allclose(seen, module(light).numpy(), rtol=1e-5)
