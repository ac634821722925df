"""Execution providers: what ONNX Runtime computes a page with, this machine's cores or a GPU."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lightpage.errors import InvalidInputError

CPU, CUDA, TENSORRT = "cpu", "cuda", "tensorrt"
_NAMES = {CPU: "CPUExecutionProvider", CUDA: "CUDAExecutionProvider", TENSORRT: "TensorrtExecutionProvider"}
"""ONNX Runtime's own names."""
WANTED = "cpu, cuda or tensorrt, with :N behind it for another GPU than the first"
_TEXT = re.compile(r"(cpu|cuda|tensorrt)(?::([0-9]{1,3}))?")


@dataclass(frozen=True)
class Provider:
    """An execution provider on one device.

    Attributes:
        name: `CPU`, `CUDA` or `TENSORRT`.
        device: number of the GPU; 0 on the CPU.
        cache: folder in which TensorRT keeps the engines that it has built, which takes minutes; None keeps none.
    """

    name: str = CPU
    device: int = 0
    cache: Path | None = None

    @classmethod
    def parse(cls, text: str, cache: Path | None = None) -> Provider:
        """The provider that a text like ``cuda:1`` names.

        Raises:
            InvalidInputError: it names none, or keeps no engines and is given a folder for them.
        """
        match = _TEXT.fullmatch(text)
        if match is None or (match[1] == CPU and match[2] is not None):
            raise InvalidInputError("provider", repr(text), WANTED)
        if cache is not None and match[1] != TENSORRT:
            raise InvalidInputError("engine cache", f"{cache} with provider {text}", f"provider {TENSORRT}, or none")
        return cls(match[1], int(match[2] or 0), cache)

    def __str__(self) -> str:
        return f"{self.name}:{self.device}" if self.device else self.name

    @property
    def runtime_name(self) -> str:
        """ONNX Runtime's name of it."""
        return _NAMES[self.name]

    @property
    def memory(self) -> str:
        """Return where its tensors lie, as ONNX Runtime calls it."""
        return "cpu" if self.name == CPU else "cuda"

    def chain(self, version: str, *, rounded: bool = False) -> list[tuple[str, dict[str, Any]]]:
        """ONNX Runtime's names with their options, the preferred one first; a node goes to the first that has it.

        Single precision stays single: a GPU would round the factors of a product to eleven bits unless it is told not
        to. A bundle in half precision has chosen that itself.

        Args:
            version: of the model. TensorRT finds an engine by the model's names alone, whatever its weights are.
            rounded: whether no product of the model must be exact. Only then is a GPU fast at those of float16 too.
        """
        cpu: tuple[str, dict[str, Any]] = (_NAMES[CPU], {})
        if self.name == CPU:
            return [cpu]
        cuda: tuple[str, dict[str, Any]] = (_NAMES[CUDA], {"device_id": self.device, "use_tf32": int(rounded)})
        if self.name == CUDA:
            return [cuda, cpu]
        options: dict[str, Any] = {"device_id": self.device}
        if self.cache is not None:
            folder = str(self.cache)
            options |= {"trt_engine_cache_enable": True, "trt_engine_cache_path": folder}
            options |= {"trt_engine_cache_prefix": f"lightpage-{version}"}
            options |= {"trt_timing_cache_enable": True, "trt_timing_cache_path": folder}
        return [(_NAMES[TENSORRT], options), cuda, cpu]


ON_CPU = Provider()
