"""The Open Inference Protocol: the same pages as by the service's own contract, and the same refusals."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import grpc
import numpy as np
import pytest
from google.protobuf.descriptor_pool import DescriptorPool
from grpc_reflection.v1alpha.proto_reflection_descriptor_database import ProtoReflectionDescriptorDatabase

from lightpage.errors import FrameError, OtherModelError
from lightpage.page.symbols import pilot_mask
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.client.pb.inference import open_inference_pb2 as oip
from lightpage.runtime.client.pb.inference import open_inference_pb2_grpc as oip_grpc
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.service.caller import Caller
from lightpage.runtime.service.frames.frames import decode
from lightpage.runtime.service.frames.inference_calls import INFERENCE, large_messages
from lightpage.runtime.service.frames.tensors import Tensor, inputs_of, parameters_message
from lightpage.runtime.service.limits import Limits
from lightpage.runtime.service.server.dispatcher import SERVICE
from tests.runtime import coded, toy
from tests.runtime.service.stage import Refused, Remembering, Running, Start, a_page, refused

ARRAYS = {"symbols": np.uint8, "confidence": np.float32, "phase": np.float32, "concentration": np.float32}
MODEL_INFER = f"/{INFERENCE.full_name}/ModelInfer"
INVALID, EXHAUSTED = grpc.StatusCode.INVALID_ARGUMENT, grpc.StatusCode.RESOURCE_EXHAUSTED
_, PAIR = a_page()


def request_of(pair: FramePair = PAIR, typed: bool = False, **parameters: Any) -> oip.ModelInferRequest:
    """A statement of what a client of the protocol sends for a pair."""
    request = oip.ModelInferRequest(model_name="lightpage")
    add(request, "in_phase", pair.in_phase, typed)
    add(request, "quadrature", pair.quadrature, typed)
    for name, value in parameters.items():
        field = {bool: "bool_param", int: "int64_param", str: "string_param", float: "double_param"}[type(value)]
        setattr(request.parameters[name], field, value)
    return request


def add(request: oip.ModelInferRequest, name: str, array: np.ndarray, typed: bool = False) -> None:
    kind = {"B": "UINT8", "H": "UINT16", "?": "BOOL"}[array.dtype.char]
    tensor = request.inputs.add(name=name, datatype=kind, shape=array.shape)
    if typed:
        tensor.contents.uint_contents.extend(array.ravel().tolist())
    else:
        request.raw_input_contents.append(array.tobytes())


def arrays(response: oip.ModelInferResponse) -> dict[str, np.ndarray]:
    contents = zip(response.outputs, response.raw_output_contents, strict=True)
    kinds = {"UINT8": np.uint8, "FP32": np.float32}
    return {one.name: np.frombuffer(raw, kinds[one.datatype]).reshape(one.shape) for one, raw in contents}


def values(response: oip.ModelInferResponse) -> dict[str, Any]:
    return {name: getattr(one, one.WhichOneof("parameter_choice")) for name, one in response.parameters.items()}


def stub_of(service: Running) -> oip_grpc.GRPCInferenceServiceStub:
    """On a connection of its own."""
    return oip_grpc.GRPCInferenceServiceStub(service.channel())


def infer(service: Running, request: oip.ModelInferRequest) -> oip.ModelInferResponse:
    channel = service.channels[0] if service.channels else service.channel()
    answer: oip.ModelInferResponse = oip_grpc.GRPCInferenceServiceStub(channel).ModelInfer(request, timeout=20)
    return answer


def fails(service: Running, request: oip.ModelInferRequest) -> Refused:
    return refused(lambda: infer(service, request))


@pytest.mark.parametrize("typed", [False, True])
def test_a_pair_gives_the_same_page_as_by_decode_frames(service: Running, typed: bool) -> None:
    own = service.client.frames.decode(PAIR, 16, stateless=True, want_phase=True, want_concentration=True)
    request = request_of(PAIR, typed, levels=16, stateless=True)
    request.id = "order-7"
    response = infer(service, request)
    found = arrays(response)
    assert list(found) == list(ARRAYS)
    for name, kind in ARRAYS.items():
        assert found[name].dtype == kind
        np.testing.assert_array_equal(found[name], getattr(own, name))
    assert (response.model_name, response.model_version, response.id) == ("lightpage", "toy-1", "order-7")
    told = values(response)
    for name in ("levels", "piston_rad", "pilot_coherence", "pilot_trust", "claimed_bits", "confirmed_bits"):
        assert told[name] == getattr(own, name)
    assert (told["recalibration_due"], told["recalibration_reasons"]) == (False, "")
    assert 0 < told["timings.decode_s"] < told["timings.total_s"]
    assert service.plane.received.used == 0
    asked = request_of(levels=16)
    for name in ("phase", "symbols"):
        asked.outputs.add(name=name)
    assert list(arrays(infer(service, asked))) == ["phase", "symbols"]  # only what is asked for


def test_every_figure_of_a_decode_reply_comes_as_a_parameter(service: Running) -> None:
    """Whatever the own contract says of a page, and is no array, nor told elsewhere in the response."""
    elsewhere = {"rows", "columns", "confidence_format", "model_version", "frame_id", "captured_s", "correlation_id"}
    told = values(infer(service, request_of(levels=16)))
    fields = pb.DecodeReply.DESCRIPTOR.fields
    scalars = {one.name for one in fields if one.type != one.TYPE_BYTES and one.type != one.TYPE_MESSAGE}
    assert told["level_phases"] == ""
    uneven = parameters_message(pb.DecodeReply(level_phases=[0.0, 0.5]))
    assert uneven["level_phases"].string_param == "0.0,0.5"
    assert scalars - elsewhere == {name for name in told if "." not in name}
    assert {f"timings.{one.name}" for one in pb.Timings.DESCRIPTOR.fields} <= set(told)


def asking_for_bytes(pair: FramePair = PAIR, **parameters: Any) -> oip.ModelInferRequest:
    request = request_of(pair, **parameters)
    request.outputs.add(name="user_data")
    return request


def test_user_bytes_come_when_asked_for(start: Start, service: Running, tmp_path: Path) -> None:
    bundle = coded.bundle(tmp_path / "coded.zip")
    shown = toy.ToyDevice(noise=8.0).page(coded.pages(bundle, tmp_path)[1], 32, 0.3)
    with_code = start(bundle=bundle)
    size = with_code.client.describe().user_bytes_per_page
    metadata = stub_of(with_code).ModelMetadata(oip.ModelMetadataRequest(name="lightpage"), timeout=20)
    assert metadata.properties["user_bytes_per_page"] == str(size)
    for pair, content, loss in ((shown, coded.CONTENT[size : 2 * size], ""), (coded.half_lost(shown), b"", "BODY")):
        response = infer(with_code, asking_for_bytes(pair))
        assert arrays(response)["user_data"].tobytes() == content
        told = values(response)
        assert (told["levels"], told["user_data.loss"]) == (32, loss)
        assert ("user_data.header.page" in told) == (not loss)
    assert fails(with_code, asking_for_bytes(levels=8)).reason == "INVALID_VALUE"
    assert fails(service, asking_for_bytes()).reason == "NO_CODE"


def test_the_service_and_its_model_describe_themselves(service: Running) -> None:
    stub = stub_of(service)
    assert stub.ServerLive(oip.ServerLiveRequest(), timeout=20).live
    assert stub.ServerReady(oip.ServerReadyRequest(), timeout=20).ready
    assert stub.ServerMetadata(oip.ServerMetadataRequest(), timeout=20).name == "lightpage"
    metadata = stub.ModelMetadata(oip.ModelMetadataRequest(name="lightpage"), timeout=20)
    assert (metadata.name, list(metadata.versions)) == ("lightpage", ["toy-1"])
    frames = [("in_phase", "UINT8", list(toy.SHAPE)), ("quadrature", "UINT8", list(toy.SHAPE))]
    assert [(one.name, one.datatype, list(one.shape)) for one in metadata.inputs] == frames
    outputs = {one.name: (one.datatype, tuple(one.shape)) for one in metadata.outputs}
    assert outputs == {name: ({np.uint8: "UINT8", np.float32: "FP32"}[kind], toy.PAGE) for name, kind in ARRAYS.items()}
    assert (metadata.properties["bit_depth"], metadata.properties["default_levels"]) == ("8", "16")
    ready = [("lightpage", "", True), ("lightpage", "toy-1", True), ("lightpage", "toy-2", False), ("bench", "", False)]
    for name, version, is_ready in ready:
        assert stub.ModelReady(oip.ModelReadyRequest(name=name, version=version), timeout=20).ready is is_ready


def test_a_service_in_trouble_is_not_ready(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    service = start()
    monkeypatch.setattr(service.plane.heart, "trouble", lambda: "a decode hangs")
    stub = stub_of(service)
    assert not stub.ServerReady(oip.ServerReadyRequest(), timeout=20).ready
    assert not stub.ModelReady(oip.ModelReadyRequest(name="lightpage"), timeout=20).ready


def test_only_the_version_in_service_decodes(start: Start, tmp_path: Path) -> None:
    service = start(limits=Limits(concurrent_decodes=1))
    service.plane.models.adopt(Decoder(Bundle.open(toy.write_toy_bundle(tmp_path / "toy-2.zip", version="toy-2")), 1))
    request, stub = request_of(levels=16), stub_of(service)
    metadata = stub.ModelMetadata(oip.ModelMetadataRequest(name="lightpage", version="toy-1"), timeout=20)
    assert list(metadata.versions) == ["toy-1", "toy-2"]
    request.model_version = "toy-2"
    assert infer(service, request).model_version == "toy-2"
    request.model_version = "toy-1"
    with service.plane.decodes.held(Caller()):  # it does not wait for its turn
        answer = fails(service, request)
    assert (answer.code, answer.reason, answer.error.got) == (grpc.StatusCode.ABORTED, "OTHER_MODEL", "toy-2")
    request.model_version = "toy-3"
    asked = oip.ModelMetadataRequest(name="lightpage", version="toy-3")
    for answer in (fails(service, request), refused(lambda: stub.ModelMetadata(asked, timeout=20))):
        assert (answer.code, answer.subject) == (grpc.StatusCode.NOT_FOUND, "model version")
    request.model_name = "bench"
    assert fails(service, request).subject == "model name"
    with pytest.raises(OtherModelError):  # where the model changes while a pair waits for its turn
        decode(service.plane, PAIR, 16, Caller(), version="toy-1")


def test_a_page_that_is_not_believed_is_no_answer(service: Running) -> None:
    symbols, mask = a_page()[0], pilot_mask(toy.PROFILE)
    other = np.random.default_rng(8).integers(16, size=toy.PAGE).astype(np.uint8)

    def known(pilots: np.ndarray) -> oip.ModelInferRequest:
        request = request_of(levels=16, pilot_levels=16)
        with_pilots(request, mask, pilots)
        return request

    assert (arrays(infer(service, known(symbols)))["symbols"] == symbols).all()
    answer = fails(service, known(other))
    assert (answer.code, answer.reason) == (grpc.StatusCode.DATA_LOSS, "PAGE_NOT_BELIEVED")


def test_sessions_are_those_of_the_own_contract(start: Start) -> None:
    service = start(tracker=Remembering)

    def piston(**parameters: Any) -> float:
        return float(values(infer(service, request_of(levels=16, **parameters)))["piston_rad"])

    assert service.client.frames.decode(PAIR, 16, session="mine").piston_rad == 1
    assert [piston(session="mine"), piston(), piston(), piston(stateless=True)] == [2, 1, 2, 1]


def with_pilots(request: oip.ModelInferRequest, mask: np.ndarray, symbols: np.ndarray | None) -> None:
    add(request, "pilot_mask", mask)
    if symbols is not None:
        add(request, "pilot_symbols", symbols)


def with_text(parameter: oip.InferParameter) -> None:
    parameter.string_param = "16"


def typed(request: oip.ModelInferRequest, change: Callable[[oip.InferTensorContents], object]) -> None:
    request.CopyFrom(request_of(typed=True))
    change(request.inputs[0].contents)


Change = Callable[[oip.ModelInferRequest], object]
NO_PILOTS, A_PAGE = np.zeros(toy.PAGE, bool), np.zeros(toy.PAGE, np.uint8)
TYPED = "inputs.in_phase.contents"
WRONG: list[tuple[Change, str, str]] = [
    (lambda r: [r.inputs.pop(), r.raw_input_contents.pop()], "inputs.quadrature", "INVALID_VALUE"),
    (lambda r: add(r, "image", A_PAGE), "inputs", "INVALID_VALUE"),
    (lambda r: add(r, "in_phase", np.zeros(toy.SHAPE, np.uint8)), "inputs.in_phase", "INVALID_VALUE"),
    (lambda r: setattr(r.inputs[0], "datatype", "UINT16"), "inputs.in_phase", "FRAME_FORMAT"),
    (lambda r: r.inputs[1].shape.reverse(), "inputs.quadrature", "FRAME_FORMAT"),
    (lambda r: r.inputs[1].shape.extend([1] * 100_000), "inputs.quadrature", "FRAME_FORMAT"),
    (lambda r: r.raw_input_contents.__setitem__(0, b"1"), "inputs.in_phase", "FRAME_FORMAT"),
    (lambda r: r.raw_input_contents.pop(), "raw_input_contents", "INVALID_VALUE"),
    (lambda r: r.inputs[0].contents.uint_contents.append(1), TYPED, "INVALID_VALUE"),
    (lambda r: r.ClearField("raw_input_contents"), f"{TYPED}.uint_contents", "FRAME_FORMAT"),
    (lambda r: typed(r, lambda c: c.uint_contents.__setitem__(6143, 256)), f"{TYPED}.uint_contents", "FRAME_FORMAT"),
    (lambda r: typed(r, lambda c: c.int_contents.append(1)), TYPED, "FRAME_FORMAT"),
    (lambda r: with_text(r.inputs[0].parameters["region"]), "inputs.in_phase.parameters", "INVALID_VALUE"),
    (lambda r: r.outputs.add(name="logits"), "outputs", "INVALID_VALUE"),
    (lambda r: [r.outputs.add(name="phase") for _ in range(2)], "outputs.phase", "INVALID_VALUE"),
    (lambda r: with_text(r.outputs.add(name="phase").parameters["top"]), "outputs.phase.parameters", "INVALID_VALUE"),
    (lambda r: with_text(r.parameters["level"]), "parameters", "INVALID_VALUE"),
    (lambda r: with_text(r.parameters["levels"]), "parameters.levels", "INVALID_VALUE"),
    (lambda r: setattr(r.parameters["levels"], "int64_param", -1), "parameters.levels", "INVALID_VALUE"),
    (lambda r: with_pilots(r, NO_PILOTS, None), "inputs.pilot_mask", "INVALID_VALUE"),
    (lambda r: with_pilots(r, (A_PAGE + np.uint8(2)).view(bool), A_PAGE), "inputs.pilot_mask", "INVALID_VALUE"),
    (lambda r: [r.outputs.add(name="phase") for _ in range(300)], "", "TOO_LARGE"),
]
"""What is changed, the field that the error names, and its reason."""


def test_what_is_wrong_with_a_request_is_named(service: Running) -> None:
    for number, (change, field, reason) in enumerate(WRONG):
        request = request_of(levels=16)
        change(request)
        answer = fails(service, request)
        assert (answer.reason, answer.code) == (reason, EXHAUSTED if reason == "TOO_LARGE" else INVALID), number
        if field:
            assert answer.told["BadRequest"].field_violations[0].field == field, number
        assert len(answer.text) < 1000
    assert service.plane.received.used == 0
    last = request_of(typed=True)
    last.inputs[0].contents.uint_contents[6143] = 255
    assert infer(service, last).outputs


def test_sixteen_bits_come_in_either_form() -> None:
    frame = np.array([[0, 255, 256], [4095, 65534, 65535]], np.uint16)
    expected = {"in_phase": Tensor("UINT16", (2, 3), FrameError)}
    for typed in (False, True):
        request = oip.ModelInferRequest()
        add(request, "in_phase", frame, typed)
        # Views of a message may begin anywhere; the graph wants numbers where a processor wants them.
        raw = [memoryview(b"x" + content)[1:] for content in request.raw_input_contents]
        found = inputs_of(request, raw, expected)["in_phase"]
        assert found.flags.aligned
        assert found.dtype == np.uint16
        np.testing.assert_array_equal(found, frame)


def test_a_whole_pair_passes_where_no_message_of_ones_own_may_be_so_large(start: Start) -> None:
    service = start(limits=Limits(message_bytes=4096, chunk_bytes=1024))
    for typed in (False, True):
        request = request_of(PAIR, typed, levels=16)
        assert request.ByteSize() > 12_000
        assert infer(service, request).outputs
    for size, reason in ((5000, "TOO_LARGE"), (10**6, "")):  # beyond the largest message of all, gRPC refuses it
        answer = refused(lambda size=size: service.stub.GetJob(pb.GetJobRequest(id="a" * size), timeout=20))  # type: ignore[misc]
        assert (answer.code, answer.reason) == (EXHAUSTED, reason)


@pytest.mark.parametrize(
    ("shape", "dtype", "largest"),
    [
        ((3000, 4000), "uint16", 2 * 12_000_000 * 2 + 2 * 400_000 + 65_536),
        ((1000, 1000), "uint8", 2 * 1_000_000 * 2 + 4 * 400_000 + 65_536),  # typed, as two bytes a pixel
        ((2000, 1000), "uint8", 8 << 20),  # typed, at most so many of them
        ((64, 96), "uint8", 4 << 20),  # as any other message
        ((40_000, 40_000), "uint8", 2**31 - 1),
    ],
)
def test_the_largest_message_is_a_pair_with_pilots(shape: tuple[int, int], dtype: str, largest: int) -> None:
    profile = SimpleNamespace(frame_shape=shape, page_shape=(16, 24) if shape == (64, 96) else (500, 800))
    bundle = SimpleNamespace(profile=profile, manifest=SimpleNamespace(frame_dtype=dtype))
    models = SimpleNamespace(current=SimpleNamespace(decoder=SimpleNamespace(bundle=bundle)))
    plane: Any = SimpleNamespace(models=models, limits=Limits())
    assert large_messages(plane) == {MODEL_INFER: largest}


def test_typed_contents_count_against_the_budget_with_what_they_take_once_parsed(start: Start) -> None:
    typed = request_of(typed=True, levels=16)
    size = typed.ByteSize() + 2 * PAIR.in_phase.size * np.dtype(np.uint32).itemsize
    assert infer(start(limits=Limits(receive_bytes=size, pair_bytes=size)), typed).outputs
    short = start(limits=Limits(receive_bytes=size - 1, pair_bytes=size - 1))
    assert infer(short, request_of(levels=16)).outputs
    answer = fails(short, typed)
    assert (answer.code, answer.reason) == (EXHAUSTED, "OVERLOADED")
    assert answer.told["RetryInfo"].retry_delay.ToSeconds() == 1
    assert short.plane.received.used == 0


def test_a_call_that_comes_too_late_is_refused_before_its_message_is_read(start: Start) -> None:
    service = start()
    call = service.channel().unary_unary(MODEL_INFER)
    answer = refused(lambda: call(b"\xff\xff", timeout=20))
    assert (answer.code, answer.reason) == (INVALID, "MALFORMED")
    service.plane.decodes.took(30.0)
    answer = refused(lambda: call(b"\xff\xff", timeout=20))
    assert (answer.code, answer.reason) == (EXHAUSTED, "DEADLINE_TOO_SHORT")


def test_calls_beyond_the_protocol_are_told_so_and_counted_under_one_name(start: Start) -> None:
    service = start()
    for method in ("ModelConfig", "RepositoryIndex", "Nonsense"):
        call = service.channel().unary_unary(f"/{INFERENCE.full_name}/{method}")
        answer = refused(lambda call=call: call(b"", timeout=20))  # type: ignore[misc]
        assert (answer.code, method in answer.text) == (grpc.StatusCode.UNIMPLEMENTED, True)
    assert service.count("lightpage_calls_total", method="inference/other", code="UNIMPLEMENTED") == 3


def test_a_service_without_the_protocol_does_not_know_it(start: Start) -> None:
    service = start(inference=False)
    answer = refused(lambda: stub_of(service).ServerLive(oip.ServerLiveRequest(), timeout=20))
    assert answer.code is grpc.StatusCode.UNIMPLEMENTED
    assert INFERENCE.full_name not in service.server.health()


def test_a_stranger_finds_the_protocol_by_reflection_alone(service: Running) -> None:
    database = ProtoReflectionDescriptorDatabase(service.channel())
    assert {SERVICE.full_name, INFERENCE.full_name, "grpc.health.v1.Health"} <= set(database.get_services())
    method = DescriptorPool(database).FindServiceByName(INFERENCE.full_name).methods_by_name["ModelInfer"]
    assert method.input_type.full_name == oip.ModelInferRequest.DESCRIPTOR.full_name
