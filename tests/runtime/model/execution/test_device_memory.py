"""Frames in pinned memory and their copies on a device, by a library that stands in for CUDA's."""

import ctypes
from typing import Any

import numpy as np
import onnx.parser
import pytest

from lightpage.errors import ProviderError
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.decoding.batch_graph import FrameBuffer
from lightpage.runtime.model.execution.device_memory import Copies, CudaRuntime
from lightpage.runtime.model.execution.providers import ON_CPU, Provider
from lightpage.runtime.model.execution.session import BoundSession, open_session

GRAPH = '<ir_version: 9, opset_import: ["" : 20]> g (uint8[2,3] x) => (uint8[2,3] y) {y = Add(x, x)}'
PAIR, STILL = FramePair(*np.full((2, 1, 3), 7, np.uint8)), np.zeros((2, 2), np.float32)
MADE = ["cudaHostRegister", "cudaMalloc", "cudaMemset", "cudaStreamCreateWithFlags"]
SENT = ["cudaMemcpyAsync", "cudaMemcpyAsync", "cudaStreamSynchronize"]


class FakeCuda:
    """Its device memory is that of the process; a function may fail."""

    def __init__(self, failing: str = "") -> None:
        self.names, self.devices, self.failing, self._held = list[str](), set[int](), failing, list[Any]()
        self.copies = Copies(Provider.parse("cuda:1"), lambda provider: CudaRuntime(self, provider))

    def __getattr__(self, name: str) -> Any:
        def call(*given: Any) -> Any:
            if name == "cudaSetDevice":
                return self.devices.add(*given)
            self.names.append(name)
            if name == "cudaMalloc":
                self._held.append(ctypes.create_string_buffer(given[1].value))
                ctypes.cast(given[0], ctypes.POINTER(ctypes.c_void_p))[0] = ctypes.addressof(self._held[-1])
            elif name == "cudaMemcpyAsync":
                ctypes.memmove(*given[:3])
            return b"out of memory" if name == "cudaGetErrorString" else 2 * (name == self.failing)

        return call


def test_pages_are_sent_to_their_buffer_s_own_memory_and_a_graph_takes_them_from_there() -> None:
    cuda, session = FakeCuda(), open_session(onnx.parser.parse_model(GRAPH).SerializeToString(), "graph", 1)
    buffers = [FrameBuffer(2, (1, 3), "uint8", cuda.copies) for _ in range(2)]
    for place, buffer in enumerate(buffers):
        buffer.put(place, PAIR, STILL)
        buffer.frames["in_phase"][:] = 0  # it lies there by now
    for place, buffer in enumerate(buffers):
        fed = buffer.feeds(slice(0, 2))["in_phase"]
        fed = type(fed)(fed.pointer, fed.dtype, (2, 3))
        found = BoundSession(session, ON_CPU, {}, "graph").run(["y"], {"x": fed})[0]
        assert found.sum(1).tolist() == [42 * (place == 0), 42 * (place == 1)]
    del buffer, buffers
    assert cuda.names == MADE * 2 + SENT * 2 + ["cudaStreamDestroy", "cudaFree", "cudaHostUnregister"] * 2
    assert cuda.devices == {1}


@pytest.mark.parametrize("failing", MADE)
def test_frames_that_cannot_be_pinned_stay_on_the_host_which_is_told_once(
    failing: str, caplog: pytest.LogCaptureFixture
) -> None:
    cuda = FakeCuda(failing)
    assert {type(FrameBuffer(1, (1, 3), "uint8", cuda.copies).feeds(slice(0, 1))["in_phase"]) for _ in "ab"} == {
        np.ndarray
    }
    assert [failing in record.getMessage() for record in caplog.records] == [cuda.names.count(failing) == 1]
    assert ("cudaFree" in cuda.names, "cudaHostUnregister" in cuda.names) == (failing in MADE[2:], failing in MADE[1:])


def test_a_device_that_fails_under_way_is_named() -> None:
    cuda = FakeCuda("cudaStreamSynchronize")
    with pytest.raises(ProviderError):
        FrameBuffer(1, (1, 3), "uint8", cuda.copies).put(0, PAIR, STILL)
    assert "cudaGetLastError" in cuda.names
