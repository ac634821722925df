"""CUDA's runtime library on the host: it notes its calls, and any of them may fail."""

import ctypes
from collections.abc import Callable
from typing import Any

from lightpage.runtime.model.execution.device_memory import CudaRuntime, DeviceTwins
from lightpage.runtime.model.execution.providers import Provider


class FakeCuda:
    """Stands in for the library; its device memory is that of the process."""

    def __init__(self, failing: str = "") -> None:
        self.calls: list[tuple[str, tuple[Any, ...]]] = []
        self.failing, self._held = failing, list[Any]()
        self.twins = DeviceTwins(Provider.parse("cuda:1"), lambda provider: CudaRuntime(self, provider))

    def names(self, *among: str) -> list[str]:
        return [name for name, _ in self.calls if name in among or not among]

    def __getattr__(self, name: str) -> Callable[..., Any]:
        def call(*given: Any) -> Any:
            self.calls.append((name, given))
            if name == "cudaGetErrorString":
                return b"out of memory"
            if name == self.failing:
                return 2
            if name == "cudaMalloc":
                self._held.append(ctypes.create_string_buffer(given[1].value))
                given[0]._obj.value = ctypes.addressof(self._held[-1])
            elif name == "cudaMemcpyAsync":
                ctypes.memmove(*given[:3])
            return 0

        call.restype = None
        return call
