"""What a GPU would make of a page: flops and bytes by kind, the longer of two times, and the sum behind it."""

from __future__ import annotations

import onnx
import pytest
from click.testing import CliRunner
from onnx import parser

from analysis.speed.roofline import LAYOUT, POINTWISE, PRODUCTS, Gpu, Load, estimate, loads, main

GRAPH = """<ir_version: 10, opset_import: ["" : 20]>
decoder (float[8, 4] in_phase, float[4, 2] quadrature) => (float[2, 8] p)
<float[4, 2] weights = {1, 2, 3, 4, 5, 6, 7, 8}>
{
  both = Add(quadrature, weights)
  product = MatMul(in_phase, both)
  flat = Transpose<perm=[1, 0]>(product)
  p = Identity(flat)
}"""
SLOW = Gpu("slow", flops_per_s=128.0, half_flops_per_s=1280.0, bytes_per_s=64.0, bus_bytes_per_s=10.0, launch_s=0.5)


def test_each_kind_asks_for_its_flops_and_bytes() -> None:
    found = loads(bytes(parser.parse_model(GRAPH).SerializeToString()), SLOW, share=0.5)
    assert found.keys() == {POINTWISE, PRODUCTS, LAYOUT}
    assert found[POINTWISE] == Load(1, 0.0, 96.0, 96 / 32)
    # 8 x 2 numbers of 4 products each; 32 + 8 + 16 numbers moved take longer
    assert found[PRODUCTS] == Load(1, 128.0, 224.0, 224 / 32)
    assert found[LAYOUT] == Load(1, 0.0, 128.0, 4.0)


def test_the_slowest_of_work_launches_and_bus_bounds_the_rate() -> None:
    by_kind = {POINTWISE: Load(3, 0.0, 0.0, 1.25)}
    found = estimate(by_kind, 40, SLOW)
    assert (found["work_s"], found["launches_s"], found["bus_s"]) == (1.25, 1.5, 4.0)
    assert (found["pages_per_s"], found["bytes_per_s"]) == (0.25, 10.0)


def test_products_of_half_precision_have_another_peak() -> None:
    text = GRAPH.replace("float[", "float16[")
    quick = Gpu("quick memory", 128.0, 1280.0, 1e9, 1.0, 0.0)
    found = loads(bytes(parser.parse_model(text).SerializeToString()), quick, share=1.0)
    assert found[PRODUCTS].seconds == pytest.approx(0.1)
    assert onnx.checker.check_model(parser.parse_model(text)) is None


def test_an_unknown_decoder_is_named() -> None:
    ended = CliRunner().invoke(main, ["--profile", "bench", "--decoder", "best"])
    assert ended.exit_code == 2
    assert "'best': wanted one of coherent" in ended.output
