"""The only importer of onnxruntime: telemetry is off before it loads, and sessions are opened in one way."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from numpy.typing import NDArray

# onnxruntime reads this once, on import, and would otherwise send usage data from 1.29 on.
os.environ["ORT_DISABLE_TELEMETRY"] = "1"

import onnxruntime  # type: ignore[import-untyped]

from lightpage.errors import BundleError
from runtime.execution.cpus import available_cpus


class Node(Protocol):
    """An input or output of a graph; `shape` holds a name or None for a free dimension."""

    name: str
    type: str
    shape: Sequence[int | str | None]


_TYPES = {
    "tensor(float)": "float32",
    "tensor(double)": "float64",
    "tensor(int32)": "int32",
    "tensor(int64)": "int64",
    "tensor(uint8)": "uint8",
    "tensor(uint16)": "uint16",
}


@dataclass(frozen=True)
class Port:
    """Numpy type and shape of a graph's input or output; None stands for a free dimension."""

    dtype: str
    shape: tuple[int | None, ...]

    @classmethod
    def of(cls, node: Node) -> Port:
        """As a session describes it."""
        shape = tuple(size if isinstance(size, int) else None for size in node.shape)
        return cls(_TYPES.get(node.type, node.type), shape)

    def admits(self, dtype: str, shape: tuple[int, ...]) -> bool:
        """Whether an array of this type and shape fits."""
        return (
            self.dtype == dtype
            and len(self.shape) == len(shape)
            and all(own in (None, other) for own, other in zip(self.shape, shape, strict=True))
        )


class Session(Protocol):
    """The part of onnxruntime's session that Lightpage uses; `run` may be called from many threads at once."""

    def get_inputs(self) -> Sequence[Node]:
        """Inputs that must be fed."""

    def get_outputs(self) -> Sequence[Node]:
        """Outputs."""

    def run(self, output_names: Sequence[str], input_feed: Mapping[str, NDArray[Any]]) -> list[NDArray[Any]]:
        """Outputs of the names asked for."""

    def end_profiling(self) -> str:
        """Path of the profile, where one is kept, with all runs so far."""


_ERRORS_ONLY = 3
_NOWHERE = os.path.join(os.sep, "nonexistent", "lightpage")


def open_session(
    model: bytes, subject: str, threads: int | None = None, *, once: bool = False, profile: Path | None = None
) -> Session:
    """Open an ONNX model held in memory on the CPU.

    Args:
        model: the serialised model; weights in other files are not looked for.
        subject: what it is, for the error, e.g. ``"bundle B: decoder.onnx"``.
        threads: threads for one run; by default as many as this process has cores.
        once: whether it will run a single time: then it is not worth while to prepare much.
        profile: beginning of the path of a file in which the runtime notes how long each node takes.

    Raises:
        BundleError: the bytes are no ONNX model that this onnxruntime can run.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = available_cpus() if threads is None else threads
    options.inter_op_num_threads = 1
    options.log_severity_level = _ERRORS_ONLY
    # Between two runs its threads would go on looking for work, on cores that receive frames and recalibrate meanwhile.
    options.add_session_config_entry("session.force_spinning_stop", "1")
    # A plan of its memory saves one run in forty of a page's time, and takes a quarter more of it.
    options.enable_mem_pattern = False
    if once:
        options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
        options.enable_cpu_mem_arena = False
    if profile is not None:
        options.enable_profiling, options.profile_file_prefix = True, str(profile)
    # A model that names an outside file for its weights must not read this machine's files.
    options.add_session_config_entry("session.model_external_initializers_file_folder_path", _NOWHERE)
    try:
        session: Session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's errors share no base class
        raise BundleError(subject, str(error).splitlines()[0], "an ONNX model of a Lightpage bundle") from None
    return session
