"""The Open Inference Protocol beside the service's own contract: health, metadata, ModelInfer."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from functools import partial
from importlib.metadata import version as installed_version
from typing import Any

import grpc
import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from lightpage.errors import FrameError, LimitError, MalformedError, NoSuchModelError, PageError
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.client.pb.inference import open_inference_pb2 as oip
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.wire.messages import message_of
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.service.admission import ReceiveBudget
from lightpage.runtime.service.caller import Call, Role
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.frames.frame_calls import FrameCalls
from lightpage.runtime.service.frames.tensors import (
    Tensor,
    inputs_of,
    outputs_of,
    parameters_message,
    parameters_of,
    typed_bytes,
)
from lightpage.runtime.service.monitoring.metrics import ServiceMetrics
from lightpage.runtime.service.rpc import rpc
from lightpage.runtime.service.stages import Stage, Stages

INFERENCE = oip.DESCRIPTOR.services_by_name["GRPCInferenceService"]
PREFIX = "inference/"
"""Of its methods' names in metrics and logs."""
MODEL = "lightpage"
"""Name of the one model, whichever bundle is in service: its versions are those of the bundles."""
PLATFORM = "onnx_onnxv1"
"""The protocol's word for ONNX in ONNX Runtime."""

PARAMETERS: dict[str, type] = {
    "levels": int,
    "black_level": int,
    "pilot_levels": int,
    "least_steps": int,
    "session": str,
    "stateless": bool,
}
"""Of a request."""
OUTPUTS = {"symbols": "UINT8", "confidence": "FP32", "phase": "FP32", "concentration": "FP32"}
"""Arrays of a page by the name of their tensor, which is that of their field of `DecodeReply` too."""
USER_DATA = "user_data"

_ELSEWHERE = frozenset(
    ["rows", "columns", "confidence_format", "model_version", "frame_id", "captured_s", "correlation_id"]
)
"""Fields of `DecodeReply` that the reply tells otherwise, or that a request cannot set."""
_WIDEST = {"uint8": 2, "uint16": 3}
"""Bytes of a typed pixel in a message, at most."""
_BESIDE = 1 << 16
"""Bytes of names, shapes and parameters."""
_TYPED_BYTES = 8 << 20
"""Typed contents of a message, at most: a pair of four million pixels. Parsed, they take many times their size."""
_MOST_BYTES = (1 << 31) - 1
"""Of a message: gRPC counts them in 32 bits."""
MOST_FIELDS = 256
"""Of a message, the elements of lists counted one by one: each input, output and parameter is one."""

_SUBJECT = "message of inference/ModelInfer"
_RAW = oip.ModelInferRequest.DESCRIPTOR.fields_by_name["raw_input_contents"].number
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
"""Wire types of protocol buffers."""
_SIZES = {_FIXED64: 8, _FIXED32: 4}
_MOST_VARINT = 10
"""Bytes of one."""


def model_inputs(bundle: Bundle) -> dict[str, Tensor]:
    """Return what the model of a bundle takes, by name."""
    frame = partial(Tensor, bundle.manifest.frame_dtype.upper(), bundle.profile.frame_shape, FrameError)
    page = bundle.profile.page_shape
    return {
        "in_phase": frame(),
        "quadrature": frame(),
        "pilot_mask": Tensor("BOOL", page, PageError, optional=True),
        "pilot_symbols": Tensor("UINT8", page, PageError, optional=True),
    }


def large_messages(plane: DataPlane) -> dict[str, int]:
    """Bytes of the largest ModelInfer that makes sense, by its full name: a pair of the device, and pilots."""
    bundle = plane.models.current.decoder.bundle
    pixels, symbols = (int(np.prod(shape)) for shape in (bundle.profile.frame_shape, bundle.profile.page_shape))
    size = 2 * pixels * np.dtype(bundle.manifest.frame_dtype).itemsize + 2 * symbols + _BESIDE
    return {f"/{INFERENCE.full_name}/ModelInfer": min(max(size, _most_beside(plane)), _MOST_BYTES)}


def _most_beside(plane: DataPlane) -> int:
    """Bytes that a ModelInfer may have beside raw contents: typed ones, as far as they make sense."""
    bundle = plane.models.current.decoder.bundle
    pixels, symbols = (int(np.prod(shape)) for shape in (bundle.profile.frame_shape, bundle.profile.page_shape))
    size = 2 * pixels * _WIDEST[bundle.manifest.frame_dtype] + 4 * symbols + _BESIDE
    return max(min(size, _TYPED_BYTES), plane.limits.message_bytes)


class InferenceCalls:
    """Handlers of the protocol. A pair that comes so is decoded as those of DecodeFrames are.

    Args:
        plane: decodes.
    """

    def __init__(self, plane: DataPlane) -> None:
        self._plane, self._frames = plane, FrameCalls(plane)
        self._most_beside = _most_beside(plane)

    @rpc(Role.READ)
    async def ServerLive(self, request: oip.ServerLiveRequest, call: Call) -> oip.ServerLiveResponse:
        """Answer that the server is alive."""
        return oip.ServerLiveResponse(live=True)

    @rpc(Role.READ)
    async def ServerReady(self, request: oip.ServerReadyRequest, call: Call) -> oip.ServerReadyResponse:
        """Return whether pages are decoded."""
        return oip.ServerReadyResponse(ready=self._ready)

    @rpc(Role.READ)
    async def ModelReady(self, request: oip.ModelReadyRequest, call: Call) -> oip.ModelReadyResponse:
        """Return whether a version is in service."""
        current = self._plane.models.current.version
        ready = self._ready and request.name == MODEL and request.version in ("", current)
        return oip.ModelReadyResponse(ready=ready)

    @rpc(Role.READ)
    async def ServerMetadata(self, request: oip.ServerMetadataRequest, call: Call) -> oip.ServerMetadataResponse:
        """Return what the service is."""
        return oip.ServerMetadataResponse(name="lightpage", version=installed_version("lightpage"))

    @rpc(Role.READ)
    def ModelMetadata(self, request: oip.ModelMetadataRequest, call: Call) -> oip.ModelMetadataResponse:
        """The model's tensors and versions."""
        self._check_known(request.name, request.version)
        decoder = self._plane.models.current.decoder
        bundle, tensor = decoder.bundle, oip.ModelMetadataResponse.TensorMetadata
        inputs, page = model_inputs(bundle), bundle.profile.page_shape
        optional = [f"{name} {known}" for name, known in inputs.items() if known.optional]
        properties = {
            "bit_depth": str(bundle.manifest.camera_bit_depth),
            "default_levels": str(self._plane.default_levels),
            "optional_inputs": ", ".join(optional),
        }
        reply = oip.ModelMetadataResponse(
            name=MODEL,
            versions=self._versions(),
            platform=PLATFORM,
            inputs=[
                tensor(name=name, datatype=known.datatype, shape=known.shape)
                for name, known in inputs.items()
                if not known.optional
            ],
            outputs=[tensor(name=name, datatype=datatype, shape=page) for name, datatype in OUTPUTS.items()],
            properties=properties,
        )
        if bundle.code is not None:
            reply.outputs.add(name=USER_DATA, datatype="UINT8", shape=[-1])
            reply.properties["user_bytes_per_page"] = str(decoder.page_codec.user_bytes)
        return reply

    @rpc(Role.DECODE, reads_later=True)
    async def ModelInfer(self, receive: Callable[[], Awaitable[bytes]], call: Call) -> oip.ModelInferResponse:
        """Decode a pair."""
        stages = call.times.page()
        stages.begin(Stage.RECEIVE)
        self._plane.check_time(call.caller.in_session("", True, least_steps=1))  # its request is not read yet
        sent = _Sent(await receive(), self._plane.received, self._most_beside)
        call.correlation_id = sent.request.id
        call.caller.actor = call.actor
        return await call.in_thread(partial(self._infer, sent, call, stages), sent.close)

    @property
    def _ready(self) -> bool:
        return not self._plane.trouble()

    def _versions(self) -> list[str]:
        return [entry.manifest.version for entry in self._plane.models.entries(stored=True)]

    def _check_known(self, name: str, version: str) -> None:
        """Check that there is a model, and a version of it; an empty one stands for that in service."""
        if name != MODEL:
            raise NoSuchModelError("model name", repr(name), MODEL)
        if version not in ("", self._plane.models.current.version) and version not in (known := self._versions()):
            raise NoSuchModelError("model version", repr(version), f"one of {', '.join(known)}, or none")

    def _infer(self, sent: _Sent, call: Call, stages: Stages) -> oip.ModelInferResponse:
        try:
            names, header, pair = self._translated(sent.request, sent.raw)
            reply = self._frames.decode(pair, header, call, stages, sent.request.model_version)
        finally:
            sent.close()
        return _response(reply, names)

    def _translated(
        self, request: oip.ModelInferRequest, raw: list[memoryview]
    ) -> tuple[list[str], pb.DecodeHeader, FramePair]:
        """Names of the outputs, and the pair with a header as DecodeFrames has it."""
        self._check_known(request.model_name, request.model_version)
        self._plane.models.expect(request.model_version)
        bundle = self._plane.models.current.decoder.bundle
        depth, dtype = bundle.manifest.camera_bit_depth, bundle.manifest.frame_dtype
        rows, columns = bundle.profile.frame_shape
        names = list(outputs_of(request, [*OUTPUTS, USER_DATA], list(OUTPUTS)))
        asked = parameters_of(request, PARAMETERS)
        options = message_of(
            pb.DecodeOptions,
            levels=asked.get("levels", 0),
            session=asked.get("session", ""),
            least_steps=asked.get("least_steps", 0),
            tracking="STATELESS" if asked.get("stateless") else "SESSION",
            want_concentration="concentration" in names,
            want_phase="phase" in names,
            want_user_data=USER_DATA in names,
        )
        header = message_of(
            pb.DecodeHeader,
            rows_px=rows,
            columns_px=columns,
            pixel_type=dtype,
            bit_depth=depth,
            options=options,
            correlation_id=request.id,
            black_level=asked.get("black_level", 0),
        )
        arrays = inputs_of(request, raw, model_inputs(bundle))
        pilots = _pilots(arrays.get("pilot_mask"), arrays.get("pilot_symbols"), asked.get("pilot_levels", 0))
        if pilots is not None:
            header.pilots.CopyFrom(pilots)
        self._frames.check(header)
        return names, header, FramePair(arrays["in_phase"], arrays["quadrature"])


class UnknownCalls(grpc.GenericRpcHandler):  # type: ignore[type-arg]  # generic in its types alone
    """Answers what clients of the protocol may ask beyond it.

    Args:
        metrics: where such calls are counted, all under one name.
    """

    def __init__(self, metrics: ServiceMetrics) -> None:
        self._calls = metrics.calls

    def service(self, handler_call_details: grpc.HandlerCallDetails) -> Any:
        """Return what refuses a call of the protocol's service; None for those of others."""
        service, _, method = handler_call_details.method.strip("/").partition("/")
        if service != INFERENCE.full_name:
            return None
        return grpc.stream_stream_rpc_method_handler(partial(self._refuse, method))

    async def _refuse(self, method: str, data: Any, context: Any) -> None:
        code = grpc.StatusCode.UNIMPLEMENTED
        self._calls.labels(f"{PREFIX}other", code.name).inc()
        expected = ", ".join(each.name for each in INFERENCE.methods)
        text = f"call of {INFERENCE.full_name}: got {method[:100]!r}, an extension or unknown, wanted one of {expected}"
        await context.abort(code, text)


class _Sent:
    """A request that has come, within a budget of memory until it is closed.

    Args:
        data: its message.
        budget: budget that takes its bytes.
        most_beside: as for `take_apart`, which says what is raised too.

    Raises:
        OverloadedError: there is no room for it.
    """

    def __init__(self, data: bytes, budget: ReceiveBudget, most_beside: int) -> None:
        self._size, self._budget = 0, budget
        self._take(len(data))
        try:
            self.request, self.raw = take_apart(data, most_beside)
            self._take(typed_bytes(self.request))
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Give back what it took from the budget."""
        size, self._size = self._size, 0
        self._budget.give_back(size)

    def _take(self, size: int) -> None:
        self._budget.take(size)
        self._size += size


def _pilots(mask: NDArray[np.bool_] | None, symbols: NDArray[np.uint8] | None, levels: int) -> pb.Pilots | None:
    """The caller's own pilots as DecodeFrames has them.

    Raises:
        PageError: one of both is missing.
        InvalidInputError: an impossible level count.
    """
    if mask is None and symbols is None:
        return None
    if mask is None or symbols is None:
        given, missing = ("pilot_symbols", "pilot_mask") if mask is None else ("pilot_mask", "pilot_symbols")
        raise PageError(f"inputs.{given}", "this tensor alone", f"{missing} too")
    return message_of(pb.Pilots, mask=mask, values=symbols[mask], levels=levels)


def _response(reply: pb.DecodeReply, names: list[str]) -> oip.ModelInferResponse:
    """A decoded page as tensors and parameters."""
    response = oip.ModelInferResponse(
        model_name=MODEL,
        model_version=reply.model_version,
        id=reply.correlation_id,
        parameters=parameters_message(reply, _ELSEWHERE),
    )
    for name in names:
        if name == USER_DATA:
            datatype, content = "UINT8", reply.user_data.data
            shape = [len(content)]
        else:
            datatype, content, shape = OUTPUTS[name], getattr(reply, name), [reply.rows, reply.columns]
        response.outputs.add(name=name, datatype=datatype, shape=shape)
        response.raw_output_contents.append(content)
    return response


def take_apart(data: bytes, most_beside: int) -> tuple[oip.ModelInferRequest, list[memoryview]]:
    """The request without `raw_input_contents`, and these as views of `data`.

    The library would copy the frames twice. It also takes many times a message's size where that is made of very many
    small parts, so what it parses is bounded.

    Args:
        data: the message.
        most_beside: bytes that it may have beside its raw contents.

    Raises:
        MalformedError: it cannot be parsed.
        LimitError: more fields than make sense, or more bytes.
    """
    view, at = memoryview(data), 0
    raw: list[memoryview] = []
    rest: list[memoryview] = []
    while at < len(data):
        if len(raw) + len(rest) == MOST_FIELDS:
            raise LimitError(_SUBJECT, f"more than {MOST_FIELDS} fields", f"at most {MOST_FIELDS}")
        begun = at
        tag, at = _varint(data, at)
        content, at = _content(data, at, tag & 7)
        if tag >> 3 == _RAW and tag & 7 == _BYTES:
            raw.append(view[content:at])
        else:
            rest.append(view[begun:at])
    if (beside := sum(map(len, rest))) > most_beside:
        expected = f"at most {most_beside}, and raw_input_contents for larger frames"
        raise LimitError(f"{_SUBJECT} beside raw_input_contents", f"{beside} bytes", expected)
    try:
        return oip.ModelInferRequest.FromString(b"".join(rest)), raw
    except DecodeError as error:
        raise _malformed(error) from None


def _content(data: bytes, at: int, kind: int) -> tuple[int, int]:
    """Return where the content of a field begins and ends."""
    if kind == _VARINT:
        return at, _varint(data, at)[1]
    if kind == _BYTES:
        size, at = _varint(data, at)
    elif kind in _SIZES:
        size = _SIZES[kind]
    else:
        raise _malformed(f"a field of wire type {kind}")
    if at + size > len(data):
        raise _malformed("a field that ends behind the message")
    return at, at + size


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """A number, and where it ends."""
    value = 0
    for index, byte in enumerate(data[at : at + _MOST_VARINT]):
        value |= (byte & 0x7F) << 7 * index
        if byte < 0x80:
            return value, at + index + 1
    raise _malformed("a number that does not end")


def _malformed(got: object) -> MalformedError:
    return MalformedError(_SUBJECT, got, "one that can be parsed")
