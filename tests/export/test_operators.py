"""The exported decoders run on CUDA and TensorRT but for the nodes named here, and a planted one is found."""

from dataclasses import replace
from pathlib import Path

import onnx
import pytest
from onnx import TensorProto, helper, parser

from lightpage.calibration.sampling_table import sampling_table
from lightpage.device.state import Device
from lightpage.errors import InvalidInputError
from lightpage.export.graph import FRAME_INPUTS, DecoderGraph, table_tensors
from lightpage.export.onnx_files import OPSET, decoder_onnx
from lightpage.export.operators.check import fallbacks, page_part, repeated_products, shape_computations
from lightpage.export.operators.collect import collect
from lightpage.export.operators.operator_list import PROVIDERS, OperatorList
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.bundle.manifest import DECODER
from lightpage.simulator.simulator import Simulator
from lightpage.simulator.true_optics import true_parameters
from lightpage.train.models.decoder import SymbolDecoder
from lightpage.train.models.presets import FAST, PRESETS
from lightpage.train.models.twin import RayTwin, TorchTwin
from tests.lightpage.command import run
from tests.lightpage.small import small_profile

ORIGIN = "someone/project docs/file.md at 0000000 (1.0)"
SMALL = "agraph (float[1, 2, 6, 8] x, float[1, 4, 4, 2] grid) => (float[1, 2, 4, 4] y)"


@pytest.fixture(scope="module")
def fast() -> bytes:
    """Return the part of a small device's fast decoder that runs for every page."""
    profile, device = small_profile(), Device()
    parameters = true_parameters(profile, device)
    choices = replace(PRESETS[FAST].choices, channels=8, blocks=1)
    graph = DecoderGraph(profile, SymbolDecoder(profile, parameters, "coherent", choices), 1.0).eval()
    table = sampling_table(TorchTwin(RayTwin(profile)), parameters, device.homodyne.turn_rad, profile)
    tensors = table_tensors(graph, table, Simulator(profile, device, seed=1).references())
    return page_part(decoder_onnx(graph, "uint8", profile.frame_shape, tensors))


def small(body: str, header: str = SMALL, opset: int = OPSET) -> bytes:
    """A graph in ONNX's own words."""
    text = f'<ir_version: 10, opset_import: ["" : {opset}, "com.microsoft" : 1]>\n{header} {{\n{body}\n}}'
    return bytes(parser.parse_model(text).SerializeToString())


@pytest.mark.parametrize("decoder", ["fast", "of two passes"])
def test_no_node_of_a_decoder_leaves_the_provider(decoder: str, fast: bytes, small_bundle: Path) -> None:
    """The decoder of two passes also holds the operators of one pass, by beams or by waves."""
    part = fast if decoder == "fast" else page_part(Bundle.open(small_bundle).files[DECODER])
    assert [fallbacks(part, provider) for provider in PROVIDERS] == [[]] * len(PROVIDERS)
    assert (shape_computations(part), repeated_products(part)) == ([], [])


@pytest.mark.parametrize(
    ("left", "right", "repeated"),
    [("2, 1, 3, 4", "1, 2, 4, 5", True), ("2, 1, 3, 4", "2, 2, 4, 5", False), ("3, 4", "2, 2, 4, 5", False)],
)
def test_a_product_that_repeats_both_of_its_factors_is_found(left: str, right: str, repeated: bool) -> None:
    model = small("y = MatMul (a, b)", f"agraph (float[{left}] a, float[{right}] b) => (float[N] y)")
    assert repeated_products(model) == (["y"] if repeated else [])


def test_frames_of_16_bits_are_converted_elsewhere_by_tensorrt_alone(fast: bytes) -> None:
    model = onnx.load_from_string(fast)
    for value in model.graph.input:
        if value.name in FRAME_INPUTS:
            value.type.tensor_type.elem_type = TensorProto.UINT16
    assert fallbacks(model.SerializeToString(), "cuda") == []
    found = fallbacks(model.SerializeToString(), "tensorrt")
    assert [(one.operator, "uint16" in one.got) for one in found] == [("Cast", True), ("Cast", True)]


def test_a_cast_planted_before_the_sampling_is_found_and_named(fast: bytes) -> None:
    model = onnx.load_from_string(fast)
    nodes = model.graph.node
    place = next(number for number, node in enumerate(nodes) if node.op_type == "GridSample")
    sampler, planted, seen = nodes[place], nodes[place].input[0], nodes[place].output[0]
    sampler.input[0], sampler.output[0] = "planted", "half"
    nodes.insert(place + 1, helper.make_node("Cast", ["half"], [seen], to=TensorProto.FLOAT))
    nodes.insert(place, helper.make_node("Cast", [planted], ["planted"], to=TensorProto.FLOAT16))
    found = fallbacks(model.SerializeToString(), "cuda")
    (new,) = set(found) - set(fallbacks(fast, "cuda"))
    assert (new.node, new.operator, new.version) == (sampler.name, "GridSample", 20)
    assert fallbacks(model.SerializeToString(), "tensorrt") == fallbacks(fast, "tensorrt")  # that samples in halves too


SHAPED = "agraph (float[4] a) => (float[4] y)"
SAMPLED = "agraph (float[1, 1, 4, 4, 4] x, float[1, 2, 2, 2, 3] grid) => (float[1, 1, 2, 2, 2] y)"
SLICED = "agraph (float[4, 4] a, int64[1] b) => (float[n, m] y)"


@pytest.mark.parametrize(
    ("provider", "model", "operator", "got"),
    [
        ("cuda", small("y = MatMul (a, a)", "agraph (int64[4, 4] a) => (int64[4, 4] y)"), "MatMul", "of int64"),
        ("tensorrt", small("y = Add (a, a)", "agraph (double[4] a) => (double[4] y)"), "Add", "of float64"),
        ("cuda", small("y = Det (a)", "agraph (float[4, 4] a) => (float y)"), "Det", "operator Det"),
        ("tensorrt", small("y = Slice (a, b, b, b)", SLICED), "Slice", "is computed"),
        ("tensorrt", small("y = GridSample (x, grid)", SAMPLED), "GridSample", "x of 5 axes"),
        ("tensorrt", small("y = Neg (a)", SHAPED, opset=21), "Neg", "opset 21"),
    ],
)
def test_what_a_provider_lacks_is_found(provider: str, model: bytes, operator: str, got: str) -> None:
    (found,) = fallbacks(model, provider)
    assert found.operator == operator
    assert got in found.got


def test_what_depends_on_constants_alone_is_not_asked_for() -> None:
    header = "agraph (float[3] x) => (float[3] y) <float[3] table = {1, 2, 3}>"
    assert fallbacks(small("t = Atan (table)\ny = Mul (x, t)", header), "cuda") == []
    (found,) = fallbacks(small("t = Atan (x)\ny = Mul (x, t)", header), "cuda")
    assert (found.node, found.operator, found.version) == ("t", "Atan", 7)


def test_computations_of_shapes_are_told_apart() -> None:
    model = small(
        """s = Shape (x)
        n = Gather (s, first)
        k = BitwiseNot (n)
        y = ConstantOfShape (k)""",
        "agraph (float[a, b] x) => (float[c] y) <int64[1] first = {0}>",
    )
    assert shape_computations(model) == ["n", "k"]
    assert fallbacks(model, "cuda") == []


def made(document: str, provider: str, folder: Path) -> OperatorList:
    """The list of a document, by way of the command and its file."""
    (folder / "D.md").write_text(document)
    out = folder / "L.json"
    run(collect, folder / "D.md", "--provider", provider, "--origin", ORIGIN, "--out", out)
    return OperatorList.from_json(out.read_text())


KERNELS = """
<a name="cpuexecutionprovider"/>
|**Operator Domain:** *ai.onnx*||||
|Atan|*in* input:**T**<br> *out* output:**T**|7+|**T** = tensor(float)|
<a name="cudaexecutionprovider"/>
| Op Name | Parameters | OpSet Version | Types Supported |
|---------|------------|---------------|-----------------|
|**Operator Domain:** *ai.onnx*||||
|Conv|*in* X:**T**<br> *out* Y:**T**|11+|**T** = tensor(double), tensor(float)|
|||[1, 10]|**T** = tensor(float)|
|GridSample|*in* X:**T1**<br> *in* grid:**T2**|16+|**T1** = tensor(float)<br/> **T2** = tensor(float)|
| |
|**Operator Domain:** *com.microsoft*||||
|Fused|*in* X:**T**<br> *in* W:**T1**<br> *out* Y:**T**<br><br>or<br><br>*in* X:**T**|1+|**T** = tensor(float)|
<a name="dmlexecutionprovider"/>
|Atan|*in* input:**T**<br> *out* output:**T**|7+|**T** = tensor(float)|
"""


def test_cudas_list_is_read_from_its_projects_document(tmp_path: Path) -> None:
    listed = made(KERNELS, "cuda", tmp_path)
    assert (listed.provider, listed.origin, listed.opsets) == ("CUDAExecutionProvider", ORIGIN, None)
    assert set(listed.operators) == {("", "Conv"), ("", "GridSample"), ("com.microsoft", "Fused")}
    newest, older = listed.operators["", "Conv"].kernels
    assert (newest.since, newest.until, set(newest.types["T"])) == (11, None, {"float32", "float64"})
    assert (older.since, older.until) == (1, 10)
    fused = listed.operators["com.microsoft", "Fused"]
    assert (fused.inputs, fused.outputs) == (("T", "T1"), ("T",))


def test_tensorrts_list_is_read_from_its_projects_document(tmp_path: Path) -> None:
    document = """
TensorRT 10.0 supports operators in the inclusive range of opset 9 to opset 20.
| Operator   | Supported | Supported Types   | Restrictions |
|------------|-----------|-------------------|--------------|
| Acos       | Y         | FP32, FP16, |
| Det        | N         |
| GridSample | Y         | FP32, BOOL | Input must be 4D input.
| Slice      | Y         | FP32, INT64 | `axes` must be an initializer   |
"""
    listed = made(document, "tensorrt", tmp_path)
    assert (listed.provider, listed.opsets) == ("TensorrtExecutionProvider", (9, 20))
    assert {name for _, name in listed.operators} == {"Acos", "GridSample", "Slice"}
    assert listed.operators["", "GridSample"].rank == 4
    assert listed.operators["", "Slice"].constant == ("axes",)
    with pytest.raises(InvalidInputError, match="FP33"):
        made(document.replace("FP32, FP16", "FP33"), "tensorrt", tmp_path)


@pytest.mark.parametrize("provider", PROVIDERS)
def test_another_document_is_refused(provider: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="operator document"):
        made("# Something else", provider, tmp_path)
