"""The Open Inference Protocol: the same pages as by the service's own contract, and the same refusals."""

from __future__ import annotations

import gc
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest
from google.protobuf.descriptor import FieldDescriptor as FIELD
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from grpc_reflection.v1alpha.proto_reflection_descriptor_database import ProtoReflectionDescriptorDatabase

from lightpage.page.symbols import pilot_mask
from lightpage.recording.frame_pair import FramePair
from runtime.bundle.bundle import Bundle
from runtime.decoding.decoder import Decoder
from runtime.errors import OtherModelError
from runtime.pb.inference import open_inference_pb2 as oip
from runtime.pb.inference import open_inference_pb2_grpc as oip_grpc
from runtime.pb.lightpage.v1 import lightpage_pb2 as pb
from runtime.rpc.inference_calls import INFERENCE
from runtime.service.caller import Caller
from runtime.service.limits import Limits
from tests.runtime import coded, toy
from tests.runtime.rpc.stage import Running, Start, a_page, wait_until
from tests.runtime.rpc.test_edge import Remembering, details, resident

ARRAYS = {"symbols": np.uint8, "confidence": np.float32, "phase": np.float32, "concentration": np.float32}
MODEL_INFER = f"/{INFERENCE.full_name}/ModelInfer"


def request_of(pair: FramePair, typed: bool = False, **parameters: Any) -> oip.ModelInferRequest:
    """A statement of what a client of the protocol sends for a pair."""
    request = oip.ModelInferRequest(model_name="lightpage")
    add(request, "in_phase", pair.in_phase, typed)
    add(request, "quadrature", pair.quadrature, typed)
    for name, value in parameters.items():
        field = {bool: "bool_param", int: "int64_param", str: "string_param", float: "double_param"}[type(value)]
        setattr(request.parameters[name], field, value)
    return request


def add(request: oip.ModelInferRequest, name: str, array: np.ndarray, typed: bool = False) -> None:
    kind = {"b": "BOOL", "B": "UINT8", "H": "UINT16", "?": "BOOL"}[array.dtype.char]
    tensor = request.inputs.add(name=name, datatype=kind, shape=array.shape)
    if not typed:
        request.raw_input_contents.append(array.tobytes())
    elif kind == "BOOL":
        tensor.contents.bool_contents.extend(array.ravel().tolist())
    else:
        tensor.contents.uint_contents.extend(array.ravel().tolist())


def arrays(response: oip.ModelInferResponse) -> dict[str, np.ndarray]:
    contents = zip(response.outputs, response.raw_output_contents, strict=True)
    kinds = {"UINT8": np.uint8, "FP32": np.float32}
    return {one.name: np.frombuffer(raw, kinds[one.datatype]).reshape(one.shape) for one, raw in contents}


def values(response: oip.ModelInferResponse) -> dict[str, Any]:
    return {name: getattr(one, one.WhichOneof("parameter_choice")) for name, one in response.parameters.items()}


@contextmanager
def stub_of(service: Running, **options: Any) -> Iterator[oip_grpc.GRPCInferenceServiceStub]:
    own = (("grpc.use_local_subchannel_pool", 1), *options.items())
    with grpc.insecure_channel(service.server.target, options=own) as channel:
        yield oip_grpc.GRPCInferenceServiceStub(channel)


def refused(call: Callable[[], object]) -> tuple[grpc.StatusCode, str, str]:
    """Status, reason and sentence of a call that fails."""
    with pytest.raises(grpc.RpcError) as error:
        call()
    return error.value.code(), details(error.value)["ErrorInfo"].reason, error.value.details()


@pytest.mark.parametrize("typed", [False, True])
def test_a_pair_gives_the_same_page_as_by_decode_frames(start: Start, typed: bool) -> None:
    service, (symbols, pair) = start(), a_page()
    own = service.client.decode(pair, 16, stateless=True, want_phase=True, want_concentration=True)
    with stub_of(service) as stub:
        request = request_of(pair, typed, levels=16, stateless=True)
        request.id = "order-7"
        response = stub.ModelInfer(request, timeout=20)
    found = arrays(response)
    assert list(found) == list(ARRAYS)
    assert (found["symbols"] == symbols).all()
    for name, kind in ARRAYS.items():
        assert found[name].dtype == kind
        np.testing.assert_array_equal(found[name], getattr(own, name))
    assert (response.model_name, response.model_version, response.id) == ("lightpage", "toy-1", "order-7")
    told = values(response)
    for name in ("levels", "piston_rad", "pilot_coherence", "pilot_trust", "claimed_bits", "confirmed_bits"):
        assert told[name] == getattr(own, name)
    assert told["recalibration_due"] is False
    assert told["recalibration_reasons"] == ""
    assert 0 < told["timings.decode_s"] < told["timings.total_s"]
    assert service.plane.received.used == 0


def test_every_figure_of_a_decode_reply_comes_as_a_parameter(start: Start) -> None:
    """Whatever the own contract says of a page, and is no array, nor told elsewhere in the response."""
    elsewhere = {"rows", "columns", "confidence_format", "model_version", "frame_id", "captured_s", "correlation_id"}
    service = start(tracker=Remembering)
    with stub_of(service) as stub:
        told = values(stub.ModelInfer(request_of(a_page()[1], levels=16), timeout=20))
    fields = pb.DecodeReply.DESCRIPTOR.fields
    scalars = {one.name for one in fields if one.type != one.TYPE_BYTES and one.type != one.TYPE_MESSAGE}
    assert scalars - elsewhere == {name for name in told if "." not in name}
    assert {f"timings.{one.name}" for one in pb.Timings.DESCRIPTOR.fields} <= set(told)


def test_only_outputs_that_are_asked_for_are_sent(start: Start) -> None:
    request = request_of(a_page()[1], levels=16)
    request.outputs.add(name="phase")
    request.outputs.add(name="symbols")
    with stub_of(start()) as stub:
        assert list(arrays(stub.ModelInfer(request, timeout=20))) == ["phase", "symbols"]


def test_user_bytes_come_when_asked_for(start: Start, tmp_path: Path) -> None:
    bundle = coded.bundle(tmp_path / "coded.zip")
    shown = toy.ToyDevice(noise=8.0).page(coded.pages(bundle, tmp_path)[1], 32, 0.3)
    service = start(bundle=bundle)
    size = service.client.describe().user_bytes_per_page
    with stub_of(service) as stub:
        metadata = stub.ModelMetadata(oip.ModelMetadataRequest(name="lightpage"), timeout=20)
        assert metadata.properties["user_bytes_per_page"] == str(size)
        for pair, content, loss in (
            (shown, coded.CONTENT[size : 2 * size], ""),
            (coded.half_lost(shown), b"", "BODY"),
        ):
            request = request_of(pair)
            request.outputs.add(name="user_data")
            response = stub.ModelInfer(request, timeout=20)
            assert arrays(response)["user_data"].tobytes() == content
            told = values(response)
            assert (told["levels"], told["user_data.loss"]) == (32, loss)
            assert ("user_data.header.page" in told) == (not loss)
        code, reason, _ = refused(lambda: stub.ModelInfer(asking_for_bytes(levels=8), timeout=20))
        assert (code, reason) == (grpc.StatusCode.INVALID_ARGUMENT, "INVALID_VALUE")


def asking_for_bytes(**parameters: Any) -> oip.ModelInferRequest:
    request = request_of(a_page()[1], **parameters)
    request.outputs.add(name="user_data")
    return request


def test_a_model_without_a_code_has_no_user_bytes(start: Start) -> None:
    with stub_of(start()) as stub:
        code, reason, _ = refused(lambda: stub.ModelInfer(asking_for_bytes(), timeout=20))
        assert (code, reason) == (grpc.StatusCode.FAILED_PRECONDITION, "NO_CODE")
        metadata = stub.ModelMetadata(oip.ModelMetadataRequest(name="lightpage"), timeout=20)
        assert [one.name for one in metadata.outputs] == list(ARRAYS)


def test_the_service_and_its_model_describe_themselves(start: Start) -> None:
    with stub_of(start()) as stub:
        assert stub.ServerLive(oip.ServerLiveRequest(), timeout=20).live
        assert stub.ServerReady(oip.ServerReadyRequest(), timeout=20).ready
        server = stub.ServerMetadata(oip.ServerMetadataRequest(), timeout=20)
        assert (server.name, list(server.extensions)) == ("lightpage", [])
        metadata = stub.ModelMetadata(oip.ModelMetadataRequest(name="lightpage"), timeout=20)
        assert (metadata.name, list(metadata.versions)) == ("lightpage", ["toy-1"])
        frames = [("in_phase", "UINT8", list(toy.SHAPE)), ("quadrature", "UINT8", list(toy.SHAPE))]
        assert [(one.name, one.datatype, list(one.shape)) for one in metadata.inputs] == frames
        page = {(one.datatype, tuple(one.shape)) for one in metadata.outputs}
        assert page == {("UINT8", toy.PAGE), ("FP32", toy.PAGE)}
        assert (metadata.properties["bit_depth"], metadata.properties["default_levels"]) == ("8", "16")
        for name, version, ready in (
            ("lightpage", "", True),
            ("lightpage", "toy-1", True),
            ("lightpage", "toy-2", False),
            ("bench", "", False),
        ):
            asked = oip.ModelReadyRequest(name=name, version=version)
            assert stub.ModelReady(asked, timeout=20).ready is ready


def test_a_hung_decode_makes_the_service_unready(start: Start) -> None:
    service = start(Limits(decode_s=0.001))
    with stub_of(service) as stub, service.plane.heart.at_work():
        gc.collect()  # longer than a decode may take here
        assert not stub.ServerReady(oip.ServerReadyRequest(), timeout=20).ready
        assert not stub.ModelReady(oip.ModelReadyRequest(name="lightpage"), timeout=20).ready
        assert stub.ServerLive(oip.ServerLiveRequest(), timeout=20).live


def test_only_the_version_in_service_decodes(start: Start, tmp_path: Path) -> None:
    service = start(Limits(concurrent_decodes=1))
    second = toy.write_toy_bundle(tmp_path / "toy-2.zip", version="toy-2")
    service.plane.adopt(Decoder(Bundle.open(second), 1))
    request = request_of(a_page()[1], levels=16)
    with stub_of(service) as stub:
        metadata = stub.ModelMetadata(oip.ModelMetadataRequest(name="lightpage", version="toy-1"), timeout=20)
        assert list(metadata.versions) == ["toy-1", "toy-2"]
        for version in ("", "toy-2"):
            request.model_version = version
            assert stub.ModelInfer(request, timeout=20).model_version == "toy-2"
        request.model_version = "toy-1"
        with service.plane.decodes.held(Caller()):  # it does not wait for its turn
            code, reason, text = refused(lambda: stub.ModelInfer(request, timeout=20))
        assert (code, reason) == (grpc.StatusCode.ABORTED, "OTHER_MODEL")
        assert text == "model in service: got toy-2, wanted toy-1"
        request.model_version = "toy-3"
        code, reason, text = refused(lambda: stub.ModelInfer(request, timeout=20))
        assert (code, reason) == (grpc.StatusCode.NOT_FOUND, "MODEL")
        assert text == "model version: got 'toy-3', wanted one of toy-1, toy-2, or none"
        asked = oip.ModelMetadataRequest(name="lightpage", version="toy-3")
        assert refused(lambda: stub.ModelMetadata(asked, timeout=20))[0] is grpc.StatusCode.NOT_FOUND
    with pytest.raises(OtherModelError):  # where the model changes while a pair waits for its turn
        service.plane.decode(a_page()[1], 16, Caller(), version="toy-1")


def test_a_page_that_is_not_believed_is_no_answer(start: Start) -> None:
    symbols, pair = a_page()
    other = np.random.default_rng(8).integers(16, size=toy.PAGE).astype(np.uint8)
    mask = pilot_mask(toy.PROFILE)
    with stub_of(start()) as stub:
        for known, code in ((symbols, grpc.StatusCode.OK), (other, grpc.StatusCode.DATA_LOSS)):
            request = request_of(pair, levels=16, pilot_levels=16)
            add(request, "pilot_mask", mask)
            add(request, "pilot_symbols", known)
            if code is grpc.StatusCode.OK:
                assert (arrays(stub.ModelInfer(request, timeout=20))["symbols"] == symbols).all()
                continue
            with pytest.raises(grpc.RpcError) as error:
                stub.ModelInfer(request, timeout=20)
            assert error.value.code() is code
            info = details(error.value)["ErrorInfo"]
            assert (info.reason, info.metadata["loss_reason"]) == ("PAGE_NOT_BELIEVED", "PILOTS_DISAGREE")


Change = Callable[[oip.ModelInferRequest], object]


def with_pilots(request: oip.ModelInferRequest, mask: np.ndarray, symbols: np.ndarray | None) -> None:
    add(request, "pilot_mask", mask)
    if symbols is not None:
        add(request, "pilot_symbols", symbols)


NO_PILOTS, A_PAGE = np.zeros(toy.PAGE, bool), np.zeros(toy.PAGE, np.uint8)
WRONG: dict[str, tuple[Change, str, str, str]] = {
    "no inputs": (
        lambda r: (r.ClearField("inputs"), r.ClearField("raw_input_contents")),
        "inputs.in_phase",
        "UINT8",
        "",
    ),
    "one input": (lambda r: (r.inputs.pop(), r.raw_input_contents.pop()), "inputs.quadrature", r"UINT8 \[64, 96\]", ""),
    "a stranger": (lambda r: add(r, "image", A_PAGE), "inputs", "'image'", ""),
    "twice": (lambda r: add(r, "in_phase", np.zeros(toy.SHAPE, np.uint8)), "inputs.in_phase", "twice", ""),
    "type": (lambda r: setattr(r.inputs[0], "datatype", "UINT16"), "inputs.in_phase", "UINT16", "FRAME_FORMAT"),
    "shape": (lambda r: r.inputs[1].shape.reverse(), "inputs.quadrature", r"\[96, 64\]", "FRAME_FORMAT"),
    "batch": (lambda r: r.inputs[1].shape.insert(0, 1), "inputs.quadrature", r"\[1, 64, 96\]", "FRAME_FORMAT"),
    "dimensions without end": (
        lambda r: r.inputs[1].shape.extend([1] * 100_000),
        "inputs.quadrature",
        "and 99994 more",
        "FRAME_FORMAT",
    ),
    "negative": (lambda r: r.inputs[1].shape.__setitem__(0, -64), "inputs.quadrature", "-64", "FRAME_FORMAT"),
    "short": (lambda r: r.raw_input_contents.__setitem__(0, b"1"), "inputs.in_phase", "1 bytes", "FRAME_FORMAT"),
    "one content": (lambda r: r.raw_input_contents.pop(), "raw_input_contents", "1 of them", ""),
    "both forms": (lambda r: r.inputs[0].contents.uint_contents.append(1), "inputs.in_phase.contents", "beside", ""),
    "no content": (
        lambda r: r.ClearField("raw_input_contents"),
        "inputs.in_phase.contents.uint_contents",
        "0",
        "FRAME_FORMAT",
    ),
    "shared memory": (
        lambda r: setattr(r.inputs[0].parameters["shared_memory_region"], "string_param", "x"),
        "inputs.in_phase.parameters",
        "shared_memory_region",
        "",
    ),
    "output": (lambda r: r.outputs.add(name="logits"), "outputs", "'logits'", ""),
    "output twice": (lambda r: [r.outputs.add(name="phase") for _ in range(2)], "outputs.phase", "twice", ""),
    "output's parameter": (
        lambda r: setattr(r.outputs.add(name="phase").parameters["classification"], "int64_param", 3),
        "outputs.phase.parameters",
        "classification",
        "",
    ),
    "parameter": (lambda r: setattr(r.parameters["level"], "int64_param", 3), "parameters", "'level'", ""),
    "parameter's type": (
        lambda r: setattr(r.parameters["levels"], "string_param", "16"),
        "parameters.levels",
        "string_param",
        "",
    ),
    "no value": (lambda r: r.parameters["levels"].Clear(), "parameters.levels", "no value", ""),
    "negative levels": (lambda r: setattr(r.parameters["levels"], "int64_param", -1), "parameters.levels", "-1", ""),
    "many levels": (lambda r: setattr(r.parameters["levels"], "int64_param", 999), "levels", "999", ""),
    "black": (lambda r: setattr(r.parameters["black_level"], "int64_param", 255), "black_level", "255", ""),
    "mask alone": (lambda r: with_pilots(r, NO_PILOTS, None), "inputs.pilot_mask", "pilot_symbols too", ""),
    "mask's shape": (lambda r: with_pilots(r, NO_PILOTS[1:], A_PAGE), "inputs.pilot_mask", r"\[15, 24\]", ""),
    "mask's values": (
        lambda r: (with_pilots(r, NO_PILOTS, A_PAGE), r.raw_input_contents.__setitem__(2, b"\2" * A_PAGE.size)),
        "inputs.pilot_mask",
        "flag of 2",
        "",
    ),
    "many fields": (lambda r: [r.outputs.add(name="phase") for _ in range(300)], "", "256 fields", "TOO_LARGE"),
    "pilots' levels": (lambda r: with_pilots(r, ~NO_PILOTS, A_PAGE + 16), "pilots", "level 16", ""),
}
"""By name: what is changed, the field that the error names, what its sentence says, and its reason if it is special."""


def test_what_is_wrong_with_a_request_is_named(start: Start) -> None:
    service = start()
    with stub_of(service) as stub:
        for name, (change, field, text, reason) in WRONG.items():
            request = request_of(a_page()[1], levels=16)
            change(request)
            with pytest.raises(grpc.RpcError, match=text) as error:
                stub.ModelInfer(request, timeout=20)
            found = details(error.value)
            assert found["ErrorInfo"].reason == (reason or "INVALID_VALUE"), name
            if reason == "TOO_LARGE":
                assert error.value.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
                continue
            assert error.value.code() is grpc.StatusCode.INVALID_ARGUMENT, name
            assert found["BadRequest"].field_violations[0].field == field, name
        assert stub.ModelInfer(request_of(a_page()[1], levels=16), timeout=20).outputs
    assert service.plane.received.used == 0


def test_typed_contents_that_do_not_fit_are_named(start: Start) -> None:
    few = request_of(a_page()[1], typed=True)
    few.inputs[1].contents.uint_contents.pop()
    large = request_of(a_page()[1], typed=True)
    large.inputs[0].contents.uint_contents[6143] = 256
    mixed = request_of(a_page()[1], typed=True)
    mixed.inputs[0].contents.int_contents.append(1)
    with stub_of(start()) as stub:
        for request, text in (
            (few, "inputs.quadrature.contents.uint_contents: got 6143 elements, wanted 6144 of UINT8 [64, 96]"),
            (large, "inputs.in_phase.contents.uint_contents: got an element of 256, wanted 0..255"),
            (mixed, "inputs.in_phase.contents: got int_contents, wanted uint_contents alone"),
        ):
            code, reason, told = refused(lambda request=request: stub.ModelInfer(request, timeout=20))  # type: ignore[misc]
            assert (code, reason, told) == (grpc.StatusCode.INVALID_ARGUMENT, "FRAME_FORMAT", text)


def test_sixteen_bits_come_in_either_form() -> None:
    from lightpage.errors import FrameError
    from runtime.rpc.tensors import Tensor, inputs_of

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


def test_sessions_are_those_of_the_own_contract(start: Start) -> None:
    service = start(tracker=Remembering)
    pair = a_page()[1]
    with stub_of(service) as one, stub_of(service) as other:

        def piston(stub: Any, **parameters: Any) -> float:
            return float(values(stub.ModelInfer(request_of(pair, levels=16, **parameters), timeout=20))["piston_rad"])

        assert [piston(one, session="mine"), piston(other, session="mine")] == [1, 2]
        assert service.client.decode(pair, 16, session="mine").piston_rad == 3
        assert [piston(one), piston(one), piston(other)] == [1, 2, 1]  # each connection's own
        assert [piston(one, stateless=True) for _ in range(2)] == [1, 1]


def test_a_whole_pair_passes_where_no_message_of_ones_own_may_be_so_large(start: Start) -> None:
    service = start(Limits(message_bytes=4096, chunk_bytes=1024))
    pair = a_page()[1]
    with stub_of(service) as stub, grpc.insecure_channel(service.server.target) as channel:
        for typed in (False, True):
            request = request_of(pair, typed, levels=16)
            assert request.ByteSize() > 12_000
            assert stub.ModelInfer(request, timeout=20).outputs
        # Their own messages have their own limit, and say so; beyond the largest message of all, gRPC does.
        for size, text in (
            (5000, "message of GetJob: got 5003 bytes, wanted at most 4096"),
            (10**6, "larger than max"),
        ):
            with pytest.raises(grpc.RpcError, match=text) as error:
                channel.unary_unary("/lightpage.v1.Lightpage/GetJob")(
                    pb.GetJobRequest(id="a" * size).SerializeToString(), timeout=20
                )
            assert error.value.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
            if size == 5000:
                assert details(error.value)["ErrorInfo"].reason == "TOO_LARGE"
        large = pb.DecodeFramesRequest(chunk=bytes(5000)).SerializeToString()
        with pytest.raises(grpc.RpcError, match="message of DecodeFrames"):
            channel.stream_unary("/lightpage.v1.Lightpage/DecodeFrames")(iter([large]), timeout=20)


def test_pairs_that_wait_count_against_the_budget(start: Start) -> None:
    service = start(Limits(receive_bytes=20_000, pair_bytes=20_000, concurrent_decodes=1))
    request = request_of(a_page()[1], levels=16)
    with stub_of(service) as stub:
        service.plane.decodes.take(Caller())
        first = stub.ModelInfer.future(request, timeout=20)
        assert wait_until(lambda: service.plane.received.used > 12_000)
        with pytest.raises(grpc.RpcError) as error:
            stub.ModelInfer(request, timeout=20)
        assert error.value.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
        assert details(error.value)["ErrorInfo"].reason == "OVERLOADED"
        assert details(error.value)["RetryInfo"].retry_delay.ToSeconds() == 1
        service.plane.decodes.give_back()
        assert first.result().outputs
    assert service.plane.received.used == 0


def test_typed_contents_count_against_the_budget_with_what_they_take_once_parsed(start: Start) -> None:
    pair = a_page()[1]
    raw, typed = request_of(pair, levels=16), request_of(pair, typed=True, levels=16)
    parsed = 2 * pair.in_phase.size * np.dtype(np.uint32).itemsize
    for size, fits in ((typed.ByteSize() + parsed, True), (typed.ByteSize() + parsed - 1, False)):
        service = start(Limits(receive_bytes=size, pair_bytes=size))
        with stub_of(service) as stub:
            stub.ModelInfer(raw, timeout=20)
            if fits:
                stub.ModelInfer(typed, timeout=20)
            else:
                code, reason, _ = refused(lambda stub=stub: stub.ModelInfer(typed, timeout=20))
                assert (code, reason) == (grpc.StatusCode.RESOURCE_EXHAUSTED, "OVERLOADED")
        assert service.plane.received.used == 0


def test_a_call_that_comes_too_late_is_refused_before_its_message_is_read(start: Start) -> None:
    service = start()
    service.plane.decodes.took(5.0)
    with grpc.insecure_channel(service.server.target) as channel:
        infer = channel.unary_unary(MODEL_INFER)
        code, reason, _ = refused(lambda: infer(b"\xff\xff", timeout=2))  # it would be malformed
        assert (code, reason) == (grpc.StatusCode.RESOURCE_EXHAUSTED, "DEADLINE_TOO_SHORT")
        code, reason, _ = refused(lambda: infer(b"\xff\xff", timeout=20))
        assert (code, reason) == (grpc.StatusCode.INVALID_ARGUMENT, "MALFORMED")


def test_large_messages_that_were_refused_leave_nothing_behind(start: Start) -> None:
    """Not even until the garbage is collected: the library keeps the last message of a stream that it reads."""
    service = start()
    request = request_of(a_page()[1])
    request.raw_input_contents[0] = bytes(3 << 20)
    data = request.SerializeToString()
    with grpc.insecure_channel(service.server.target) as channel:
        infer, before = channel.unary_unary(MODEL_INFER), 0
        gc.disable()
        try:
            for turn in range(60):
                assert refused(lambda: infer(data, timeout=20))[1] == "FRAME_FORMAT"
                if turn == 9:
                    before = resident()
            assert resident() - before < 15 * len(data)
        finally:
            gc.enable()


def test_calls_beyond_the_protocol_are_told_so_and_counted_under_one_name(start: Start) -> None:
    service = start()
    with grpc.insecure_channel(service.server.target) as channel:
        for method in ("ModelConfig", "RepositoryIndex", "Nonsense"):
            with pytest.raises(grpc.RpcError, match=f"got '{method}'.*wanted one of ServerLive") as error:
                channel.unary_unary(f"/{INFERENCE.full_name}/{method}")(b"", timeout=20)
            assert error.value.code() is grpc.StatusCode.UNIMPLEMENTED
    assert service.count("lightpage_calls_total", method="inference/other", code="UNIMPLEMENTED") == 3


def test_calls_are_counted_and_logged_with_the_id_of_the_request(
    start: Start, caplog: pytest.LogCaptureFixture
) -> None:
    service = start()
    request = request_of(a_page()[1], levels=999)
    request.id = "order-9"
    with caplog.at_level(logging.INFO), stub_of(service) as stub:
        refused(lambda: stub.ModelInfer(request, timeout=20))
        stub.ServerLive(oip.ServerLiveRequest(), timeout=20)
    (told,) = (record.told for record in caplog.records if hasattr(record, "told"))
    assert (told["method"], told["correlation_id"]) == ("inference/ModelInfer", "order-9")
    assert service.count("lightpage_calls_total", method="inference/ModelInfer", code="INVALID_ARGUMENT") == 1
    assert service.count("lightpage_calls_total", method="inference/ServerLive", code="OK") == 1


def test_a_service_without_the_protocol_does_not_know_it(start: Start) -> None:
    service = start(inference=False)
    with stub_of(service) as stub, pytest.raises(grpc.RpcError) as error:
        stub.ServerLive(oip.ServerLiveRequest(), timeout=20)
    assert error.value.code() is grpc.StatusCode.UNIMPLEMENTED
    assert INFERENCE.full_name not in service.server.health()
    assert service.client.decode(a_page()[1], 16).levels == 16


def test_a_stranger_finds_and_calls_the_protocol_by_reflection_alone(start: Start) -> None:
    symbols, pair = a_page()
    with grpc.insecure_channel(start().server.target) as channel:
        database = ProtoReflectionDescriptorDatabase(channel)
        (name,) = (one for one in database.get_services() if one.startswith("inference."))
        method = DescriptorPool(database).FindServiceByName(name).methods_by_name["ModelInfer"]
        asked = GetMessageClass(method.input_type)
        assert asked is not oip.ModelInferRequest
        request = asked.FromString(request_of(pair, levels=16).SerializeToString())
        call = channel.unary_unary(
            f"/{name}/ModelInfer", asked.SerializeToString, GetMessageClass(method.output_type).FromString
        )
        response = call(request, timeout=20)
    assert response.outputs[0].name == "symbols"
    assert response.raw_output_contents[0] == symbols.tobytes()


SPECIFIED = """
ServerLiveResponse live=1:bool
ServerReadyResponse ready=1:bool
ModelReadyRequest name=1:string version=2:string
ModelReadyResponse ready=1:bool
ServerMetadataResponse name=1:string version=2:string extensions=3:string*
ModelMetadataRequest name=1:string version=2:string
ModelMetadataResponse name=1:string versions=2:string* platform=3:string inputs=4:message* outputs=5:message* properties=6:message*
ModelMetadataResponse.TensorMetadata name=1:string datatype=2:string shape=3:int64*
ModelInferRequest model_name=1:string model_version=2:string id=3:string parameters=4:message* inputs=5:message* outputs=6:message* raw_input_contents=7:bytes*
ModelInferRequest.InferInputTensor name=1:string datatype=2:string shape=3:int64* parameters=4:message* contents=5:message
ModelInferRequest.InferRequestedOutputTensor name=1:string parameters=2:message*
ModelInferResponse model_name=1:string model_version=2:string id=3:string parameters=4:message* outputs=5:message* raw_output_contents=6:bytes*
ModelInferResponse.InferOutputTensor name=1:string datatype=2:string shape=3:int64* parameters=4:message* contents=5:message
InferParameter bool_param=1:bool int64_param=2:int64 string_param=3:string double_param=4:double uint64_param=5:uint64
InferTensorContents bool_contents=1:bool* int_contents=2:int32* int64_contents=3:int64* uint_contents=4:uint32* uint64_contents=5:uint64* fp32_contents=6:float* fp64_contents=7:double* bytes_contents=8:bytes*
"""  # noqa: E501
"""Fields of the public specification that have any: name=number:type, * where repeated."""


def test_the_protocol_is_that_of_the_public_specification() -> None:
    kinds = {
        value: name.removeprefix("TYPE_").lower() for name, value in vars(FIELD).items() if name.startswith("TYPE_")
    }
    found = []

    def describe(message: Any, prefix: str = "") -> None:
        repeated = [(one, "*" * one.is_repeated) for one in message.fields]
        told = " ".join(f"{one.name}={one.number}:{kinds[one.type]}{star}" for one, star in repeated)
        if told and not message.GetOptions().map_entry:
            found.append(f"{prefix}{message.name} {told}")
        for inner in message.nested_types:
            describe(inner, f"{prefix}{message.name}.")

    for message in oip.DESCRIPTOR.message_types_by_name.values():
        describe(message)
    assert sorted(found) == sorted(SPECIFIED.split("\n")[1:-1])
    assert INFERENCE.full_name == "inference.GRPCInferenceService"
    ways = {(one.name, one.input_type.name, one.output_type.name) for one in INFERENCE.methods}
    names = ("ServerLive", "ServerReady", "ModelReady", "ServerMetadata", "ModelMetadata", "ModelInfer")
    assert ways == {(name, f"{name}Request", f"{name}Response") for name in names}
