"""Calls to each server, from frames that are arrays to answers that are arrays; each caller has its own connection."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.client import HTTPConnection
from select import select
from typing import Any

import grpc
import numpy as np
from numpy.typing import NDArray

from analysis.service.other_servers.graphs import Graph
from analysis.service.other_servers.onnx_run import OUTPUT
from lightpage.errors import LightpageError
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.client.answers import RemotePage
from lightpage.runtime.client.client import LightpageClient
from lightpage.runtime.client.pb.inference import open_inference_pb2 as oip
from lightpage.runtime.client.wire.messages import REPLY_BYTES
from lightpage.runtime.service.frames.inference_calls import INFERENCE
from lightpage.runtime.service.frames.tensors import RAW_TYPES

Answer = dict[str, NDArray[Any]]
"""Arrays by name."""
WORK_S = "work_s"
"""Name of what the service tells of itself: seconds of its checks and decision, the run of the graph left out."""
_TIMING = "timings.{}_s"
Call = Callable[[], Answer]

CALL_S = 120.0
_PREFIX = struct.Struct("<I")
"""Length of an element of type BYTES, before it."""
_FRAMES = "application/x-frames"
"""Type of a body over HTTP: KServe would read the common one as JSON."""
_INFER = f"/{INFERENCE.full_name}/ModelInfer"


def infer_request(
    model: str, pair: FramePair, outputs: tuple[str, ...], as_bytes: bool = False
) -> oip.ModelInferRequest:
    """A pair in raw contents.

    Args:
        model: name of the model.
        pair: uint8 or uint16.
        outputs: names of the outputs that are wanted.
        as_bytes: whether a frame goes as one element of type BYTES.
    """
    request = oip.ModelInferRequest(model_name=model)
    for name, frame in (("in_phase", pair.in_phase), ("quadrature", pair.quadrature)):
        if as_bytes:
            request.inputs.add(name=name, datatype="BYTES", shape=[1])
            request.raw_input_contents.append(_PREFIX.pack(frame.nbytes) + frame.tobytes())
        else:
            request.inputs.add(name=name, datatype=frame.dtype.name.upper(), shape=frame.shape)
            request.raw_input_contents.append(frame.tobytes())
    for name in outputs:
        request.outputs.add(name=name)
    return request


def arrays_of(response: oip.ModelInferResponse) -> Answer:
    """Tensors of an answer in raw contents by name, and `WORK_S` where it is told.

    One of type BYTES is taken as float32, without a shape.

    Raises:
        LightpageError: tensors without contents, or whose contents contradict their shape.
    """
    contents = response.raw_output_contents
    if len(contents) != len(response.outputs):
        got = f"{len(response.outputs)} tensors, {len(contents)} raw contents"
        raise LightpageError("answer", got, "contents for each")
    found: Answer = {}
    for tensor, content in zip(response.outputs, contents, strict=True):
        subject = f"answer's {tensor.name}"
        if tensor.datatype == "BYTES":
            if len(content) < _PREFIX.size or _PREFIX.unpack_from(content)[0] != len(content) - _PREFIX.size:
                raise LightpageError(subject, f"{len(content)} bytes", "one element of type BYTES")
            found[tensor.name] = np.frombuffer(content, "<f4", offset=_PREFIX.size)
            continue
        dtype = RAW_TYPES[tensor.datatype]
        if len(content) != dtype.itemsize * int(np.prod(tensor.shape)):
            raise LightpageError(subject, f"{len(content)} bytes", f"{tensor.datatype} {list(tensor.shape)}")
        found[tensor.name] = np.frombuffer(content, dtype).reshape(tuple(tensor.shape))
    if _TIMING.format("decode") in response.parameters:
        decode, run = (response.parameters[_TIMING.format(each)].double_param for each in ("decode", "inference"))
        found[WORK_S] = np.array(decode - run)
    return found


@contextmanager
def inference_caller(
    target: str, model: str, pair: FramePair, outputs: tuple[str, ...], as_bytes: bool = False
) -> Iterator[Call]:
    """Calls a server by the Open Inference Protocol; arguments as those of `infer_request`."""
    options = (
        ("grpc.max_receive_message_length", REPLY_BYTES),
        ("grpc.use_local_subchannel_pool", 1),
        ("grpc.enable_http_proxy", 0),
    )
    with grpc.insecure_channel(target, options) as channel:
        infer = channel.unary_unary(_INFER, oip.ModelInferRequest.SerializeToString, oip.ModelInferResponse.FromString)
        yield lambda: arrays_of(infer(infer_request(model, pair, outputs, as_bytes), timeout=CALL_S))


@contextmanager
def bytes_caller(port: int, path: str, graph: Graph) -> Iterator[Call]:
    """Posts both frames, one behind the other; the answer is p."""
    connection = HTTPConnection("127.0.0.1", port, timeout=CALL_S)
    shape = (2, *graph.page_shape)

    def call() -> Answer:
        if connection.sock is not None and select([connection.sock], [], [], 0)[0]:
            connection.close()  # the server has ended it, since it was idle; the next request opens it anew
        body = b"".join(frame.tobytes() for frame in (graph.pair.in_phase, graph.pair.quadrature))
        connection.request("POST", path, body, {"Content-Type": _FRAMES})
        answer = connection.getresponse()
        content = answer.read()
        if answer.status != 200:
            raise LightpageError("answer over HTTP", f"status {answer.status}", "200")
        return {OUTPUT: np.frombuffer(content, "<f4").reshape(shape)}

    try:
        yield call
    finally:
        connection.close()


@contextmanager
def chunk_caller(target: str, graph: Graph) -> Iterator[Call]:
    """Calls the service by its own contract: frames in chunks."""
    with LightpageClient(target, CALL_S) as client:
        client.describe()

        def call() -> Answer:
            return _of_page(client.frames.decode(graph.pair))

        yield call


@contextmanager
def memory_caller(target: str, graph: Graph) -> Iterator[Call]:
    """Call the service over a Unix socket, with shared memory that frames are copied into."""
    with LightpageClient(target, CALL_S) as client, client.frames.share_memory() as memory:

        def call() -> Answer:
            return _of_page(client.frames.decode(graph.pair, memory=memory))

        yield call


def _of_page(page: RemotePage) -> Answer:
    work = np.array(page.timings.decode_s - page.timings.inference_s)
    return {"symbols": page.symbols, "confidence": page.confidence, WORK_S: work}
