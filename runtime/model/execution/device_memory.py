"""Memory of a GPU for frames: they lie pinned on the host, and are copied there while the graph runs."""

from __future__ import annotations

import ctypes
import logging
import weakref
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

from numpy.typing import NDArray

from lightpage.errors import ProviderError
from lightpage.runtime.model.execution.providers import ON_CPU, Provider
from lightpage.runtime.model.execution.session import CUDA_VERSION, OnDevice

_log = logging.getLogger(__name__)

_PORTABLE, _NON_BLOCKING, _HOST_TO_DEVICE = 1, 1, 1
"""cudaHostRegisterPortable, cudaStreamNonBlocking and cudaMemcpyHostToDevice."""
_WANTED = "success"


class CudaRuntime:
    """CUDA's runtime library. Its calls release the interpreter's lock.

    Args:
        library: library by ctypes.
        provider: provider whose GPU is used.
    """

    def __init__(self, library: Any, provider: Provider) -> None:
        self._library, self._provider = library, provider
        library.cudaGetErrorString.restype = ctypes.c_char_p

    @classmethod
    def of(cls, provider: Provider) -> CudaRuntime:
        """The library that ONNX Runtime has loaded for a GPU.

        Raises:
            OSError: there is none.
        """
        return cls(ctypes.CDLL(f"libcudart.so.{CUDA_VERSION.partition('.')[0]}"), provider)

    def call(self, name: str, *arguments: Any) -> None:
        """Call a function on the provider's GPU.

        Raises:
            ProviderError: its status is an error.
        """
        for each, given in (("cudaSetDevice", (self._provider.device,)), (name, arguments)):  # the thread's device
            if code := getattr(self._library, each)(*given):
                self._library.cudaGetLastError()  # or ONNX Runtime would take it for its own
                told = (self._library.cudaGetErrorString(code) or b"").decode()
                raise ProviderError(f"provider {self._provider}", f"{each}: error {code}, {told}", _WANTED)

    def release(self, name: str, *arguments: Any) -> None:
        """Call a function that frees something; what it says is of no use any more."""
        getattr(self._library, name)(*arguments)


class DeviceCopy:
    """An array's copy on a device, to which parts are copied on a stream of its own, whatever else runs there.

    The array is pinned, which makes copies several times as fast. Both are released with this. Parts may be sent from
    many threads at once, but not while a graph reads them.

    Args:
        runtime: runtime of the device.
        array: array in C order; zero on the device until it is sent.

    Raises:
        ProviderError: it cannot be pinned, or there is no room on the device.
    """

    def __init__(self, runtime: CudaRuntime, array: NDArray[Any]) -> None:
        self._runtime, self._array = runtime, array
        host, size, pointer, stream = (
            _pointer(array),
            ctypes.c_size_t(array.nbytes),
            ctypes.c_void_p(),
            ctypes.c_void_p(),
        )
        with ExitStack() as made:
            runtime.call("cudaHostRegister", host, size, _PORTABLE)
            made.callback(_unregistered, runtime, array)
            runtime.call("cudaMalloc", ctypes.byref(pointer), size)
            made.callback(runtime.release, "cudaFree", pointer)
            runtime.call("cudaMemset", pointer, 0, size)
            runtime.call("cudaStreamCreateWithFlags", ctypes.byref(stream), _NON_BLOCKING)
            made.callback(runtime.release, "cudaStreamDestroy", stream)
            weakref.finalize(self, made.pop_all().close)
        self._device, self._stream = pointer.value or 0, stream

    def send(self, *parts: NDArray[Any]) -> None:
        """Copy parts of the array, views in C order, and wait until they are there.

        Raises:
            ProviderError: the device failed.
        """
        for part in parts:
            there = ctypes.c_void_p(self.of(part).pointer)
            size = ctypes.c_size_t(part.nbytes)
            self._runtime.call("cudaMemcpyAsync", there, _pointer(part), size, _HOST_TO_DEVICE, self._stream)
        self._runtime.call("cudaStreamSynchronize", self._stream)

    def of(self, part: NDArray[Any]) -> OnDevice:
        """Return where a part of the array, a view in C order, lies on the device."""
        return OnDevice(self._device + part.ctypes.data - self._array.ctypes.data, part.dtype, part.shape)


class Copies:
    """Makes arrays' copies where pages are computed on a GPU, as long as that goes well.

    Args:
        provider: provider that computes them.
        runtime: gives the device's library.
    """

    def __init__(self, provider: Provider, runtime: Callable[[Provider], CudaRuntime] = CudaRuntime.of) -> None:
        self._provider, self._runtime = provider, runtime
        self._is_wanted = provider.memory != ON_CPU.memory

    def of(self, array: NDArray[Any]) -> DeviceCopy | None:
        """The copy of an array; None on the CPU, and from the first failure on, which is logged."""
        if not self._is_wanted:
            return None
        try:
            return DeviceCopy(self._runtime(self._provider), array)
        except (OSError, ProviderError) as error:
            self._is_wanted = False
            _log.warning("frames of %s are not pinned, and wait to be copied: %s", self._provider, error)
            return None


ON_NO_DEVICE = Copies(ON_CPU)


def _pointer(array: NDArray[Any]) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def _unregistered(runtime: CudaRuntime, array: NDArray[Any]) -> None:
    """Release an array's pin; it is held until then."""
    runtime.release("cudaHostUnregister", _pointer(array))
