"""Frames in pinned memory and their twins on a device, by a library that stands in for CUDA's."""

import ctypes
import gc
import logging

import numpy as np
import onnx.parser
import pytest

from lightpage.errors import ProviderError
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.decoding.batch_graph import FrameBuffer
from lightpage.runtime.model.execution.providers import ON_CPU
from lightpage.runtime.model.execution.session import BoundSession, open_session
from tests.runtime.model.execution.fake_cuda import FakeCuda

SHAPE, STILL = (3, 5), np.zeros((2, 2), np.float32)


def on_device(buffer: FrameBuffer, pages: slice) -> list[np.ndarray]:
    found = [buffer.feeds(pages)[name] for name in ("in_phase", "quadrature")]
    return [np.frombuffer(ctypes.string_at(a.pointer, int(np.prod(a.shape))), a.dtype).reshape(a.shape) for a in found]


def test_each_buffer_has_its_own_memory_on_the_device_and_releases_it() -> None:
    cuda, frames = FakeCuda(), np.arange(60, dtype=np.uint8).reshape(2, 2, *SHAPE)
    buffers = [FrameBuffer(2, SHAPE, "uint8", cuda.twins) for _ in range(2)]
    for place, (buffer, pair) in enumerate(zip(buffers, frames, strict=True)):
        buffer.put(place, FramePair(*pair), STILL)
    for place, (buffer, pair) in enumerate(zip(buffers, frames, strict=True)):
        assert np.array_equal(on_device(buffer, slice(place, place + 1)), pair[:, None])
    assert [given for name, given in cuda.calls if name == "cudaSetDevice"] == [(1,)] * 14
    assert cuda.names("cudaMemcpyAsync", "cudaStreamSynchronize")[:3] == ["cudaMemcpyAsync"] * 2 + [
        "cudaStreamSynchronize"
    ]
    cuda.calls.clear()
    del buffer, buffers
    gc.collect()
    assert cuda.names() == ["cudaStreamDestroy", "cudaFree", "cudaHostUnregister"] * 2


def test_a_graph_takes_what_lies_on_the_device() -> None:
    array = np.zeros((2, 3), np.float32)
    twin = FakeCuda().twins.of(array)
    assert twin is not None
    array[1] = 7
    twin.send(array[1])
    array[1] = 0  # it lies there by now
    text = '<ir_version: 9, opset_import: ["" : 20]> g (float[1,3] x) => (float[1,3] y) {y = Add(x, x)}'
    model = onnx.parser.parse_model(text).SerializeToString()
    bound = BoundSession(open_session(model, "graph", 1), ON_CPU, {}, "graph")
    assert bound.run(["y"], {"x": twin.of(array[1:])})[0].tolist() == [[14, 14, 14]]


@pytest.mark.parametrize(
    ("failing", "undone"), [("cudaHostRegister", 0), ("cudaMalloc", 1), ("cudaStreamCreateWithFlags", 2)]
)
def test_frames_that_cannot_be_pinned_stay_where_they_are_which_is_told_once(
    failing: str, undone: int, caplog: pytest.LogCaptureFixture
) -> None:
    cuda = FakeCuda(failing)
    with caplog.at_level(logging.WARNING):
        feeds = [FrameBuffer(2, SHAPE, "uint8", cuda.twins).feeds(slice(0, 2))["in_phase"] for _ in range(2)]
    assert [type(fed) for fed in feeds] == [np.ndarray] * 2
    assert len(caplog.records) == cuda.names().count(failing) == 1
    assert failing in caplog.text
    assert len(cuda.names("cudaFree", "cudaHostUnregister")) == undone


def test_a_device_that_fails_under_way_is_named() -> None:
    cuda = FakeCuda("cudaStreamSynchronize")
    buffer = FrameBuffer(1, SHAPE, "uint8", cuda.twins)
    with pytest.raises(ProviderError):
        buffer.put(0, FramePair(*np.ones((2, *SHAPE), np.uint8)), STILL)
    assert "cudaGetLastError" in cuda.names()
