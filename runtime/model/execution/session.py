"""The only importer of onnxruntime: telemetry is off before it loads, and sessions are opened in one way."""

from __future__ import annotations

import os
from collections.abc import Container, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

# onnxruntime reads this once, on import, and would otherwise send usage data from 1.29 on.
os.environ["ORT_DISABLE_TELEMETRY"] = "1"

import onnxruntime  # type: ignore[import-untyped]

from lightpage.errors import BundleError, ProviderError, SurroundingsError
from lightpage.failures import short_resource
from lightpage.runtime.model.execution.cpus import available_cpus
from lightpage.runtime.model.execution.providers import ON_CPU, Provider

_NUMPY_NAMES = {"float": "float32", "double": "float64"}
"""Of the types whose names differ in ONNX."""


# Sessions share one arena. Graphs that run in turn then need as much memory as the largest of them.
onnxruntime.create_and_register_allocator(
    onnxruntime.OrtMemoryInfo(
        "Cpu", onnxruntime.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, onnxruntime.OrtMemType.DEFAULT
    ),
    onnxruntime.OrtArenaCfg({}),
)


@dataclass(frozen=True)
class Port:
    """Numpy type and shape of a graph's input or output; None stands for a free dimension."""

    dtype: str
    shape: tuple[int | None, ...]

    @classmethod
    def of(cls, node: onnxruntime.NodeArg) -> Port:
        """Return the port that a session describes; a name or None stands for a free dimension."""
        shape = tuple(size if isinstance(size, int) else None for size in node.shape)
        kind = node.type.removeprefix("tensor(").removesuffix(")")
        return cls(_NUMPY_NAMES.get(kind, kind), shape)

    def admits(self, dtype: str, shape: tuple[int, ...]) -> bool:
        """Return whether an array of this type and shape fits."""
        return (
            self.dtype == dtype
            and len(self.shape) == len(shape)
            and all(own in (None, other) for own, other in zip(self.shape, shape, strict=True))
        )


@dataclass(frozen=True)
class OnDevice:
    """An array in the memory of what computes, row after row.

    Attributes:
        pointer: address of the first element.
        dtype, shape: type and shape of the array.
    """

    pointer: int
    dtype: np.dtype[Any]
    shape: tuple[int, ...]


Session: TypeAlias = onnxruntime.InferenceSession
VERSION: str = onnxruntime.__version__
CUDA_VERSION: str = getattr(onnxruntime, "cuda_version", "")
"""That this onnxruntime was built for; empty for CPUs."""
_USABLE = "a GPU of that number with room for the model, its driver and its libraries"
_VERSION_DIGITS = 16
_FATAL_ONLY = 4
_SHARED_ARENA = "session.use_env_allocators"
_NOWHERE = os.path.join(os.sep, "nonexistent", "lightpage")


def open_session(
    model: bytes,
    subject: str,
    threads: int | None = None,
    *,
    once: bool = False,
    profile: Path | None = None,
    provider: Provider = ON_CPU,
    rounded: bool = False,
    constants: Mapping[str, bytes] | None = None,
) -> Session:
    """Open an ONNX model held in memory.

    Args:
        model: the serialised model. It may refer to constants in `constants`, but not to files of this machine.
        subject: what it is, for the error, e.g. ``"bundle B: decoder.onnx"``.
        threads: threads for one run on the CPU; by default as many as this process has cores.
        once: whether it will run a single time: then it is not worth while to prepare much.
        profile: beginning of the path of a file in which the runtime notes how long each node takes.
        provider: what it runs on.
        rounded: whether its products may be rounded, as those of a graph for batches.
        constants: contents of the files that hold constants of the model, by the names that it uses for them.

    Raises:
        BundleError: the bytes are no ONNX model that this onnxruntime can run.
        ProviderError: there is no such provider here.
        SurroundingsError: memory or threads are short.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = available_cpus() if threads is None else threads
    options.inter_op_num_threads = 1
    options.log_severity_level = _FATAL_ONLY  # errors are raised
    # Between two runs its threads would go on looking for work, on cores that receive frames and recalibrate meanwhile.
    options.add_session_config_entry("session.force_spinning_stop", "1")
    # A plan of its memory saves one run in forty of a page's time, and takes a quarter more of it.
    options.enable_mem_pattern = False
    if once:
        options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
        options.enable_cpu_mem_arena = False
    else:
        options.add_session_config_entry(_SHARED_ARENA, "1")
    if profile is not None:
        options.enable_profiling, options.profile_file_prefix = True, str(profile)
    # A model that names an outside file for its weights must not read this machine's files.
    options.add_session_config_entry("session.model_external_initializers_file_folder_path", _NOWHERE)
    if constants:
        contents = [*constants.values()]
        options.add_external_initializers_from_files_in_memory([*constants], contents, [*map(len, contents)])
    check_provider(provider)
    if provider.memory != ON_CPU.memory:
        os.environ.setdefault("NVIDIA_TF32_OVERRIDE", "0")  # TensorRT would round float32, and has no option against it
        onnxruntime.preload_dlls()  # they may be packages of this environment, where no linker looks
    version = sha256(model).hexdigest()[:_VERSION_DIGITS]
    try:
        with running(subject, provider):
            # by default it would print the cause, and compute elsewhere
            chain = provider.chain(version, rounded=rounded)
            session = onnxruntime.InferenceSession(model, options, providers=chain, enable_fallback=0)
    except (ProviderError, SurroundingsError):
        raise
    except Exception as error:  # onnxruntime's errors share no base class
        raise BundleError(subject, _cause(error), "an ONNX model of a Lightpage bundle") from None
    if (found := session.get_providers()[0]) != provider.runtime_name:
        raise ProviderError(f"provider {provider}", f"{found} in its place", _USABLE)
    return session


@contextmanager
def running(subject: str, provider: Provider = ON_CPU) -> Iterator[None]:
    """While a session is opened or runs: a short resource and a GPU's failures by name.

    Other failures on the CPU are the graph's.

    Raises:
        ProviderError: a GPU failed, or has no room.
        SurroundingsError: memory or threads are short.
    """
    try:
        yield
    except Exception as error:  # onnxruntime's errors share no base class
        if provider != ON_CPU:
            raise ProviderError(f"provider {provider}", _cause(error), _USABLE) from None
        if (short := short_resource(subject, error)) is not None:
            raise short from None
        raise


def _cause(error: Exception) -> str:
    """The first line of what onnxruntime says."""
    return next(iter(str(error).splitlines()), type(error).__name__)


def check_provider(provider: Provider) -> None:
    """Check that this onnxruntime was built for a provider.

    Raises:
        ProviderError: it was not.
    """
    available = onnxruntime.get_available_providers()
    if provider.runtime_name not in available:
        expected = "onnxruntime-gpu in place of onnxruntime (docs/guides/speed.md), or provider cpu"
        raise ProviderError(f"provider {provider}", f"an onnxruntime with {', '.join(available)}", expected)


class BoundSession:
    """A session and tensors that it is run with every time: they lie where it computes, and are not sent again.

    It never changes; `run` may be called from many threads at once.

    Args:
        session: opened with this provider.
        provider: what it runs on.
        fixed: by input.
        subject: what it is, for errors.

    Raises:
        ProviderError: a GPU has no room for them.
        SurroundingsError: memory is short.
    """

    def __init__(self, session: Session, provider: Provider, fixed: Mapping[str, NDArray[Any]], subject: str) -> None:
        self.session, self._subject, self._provider = session, subject, provider
        with running(subject, provider):
            self._fixed = {
                name: onnxruntime.OrtValue.ortvalue_from_numpy(
                    np.asarray(value, order="C"), provider.memory, provider.device
                )
                for name, value in fixed.items()
            }

    def binding(self, without: Container[str] = ()) -> Any:
        """onnxruntime's binding of the tensors that lie there, but for some."""
        binding = self.session.io_binding()
        for name, value in self._fixed.items():
            if name not in without:
                binding.bind_ortvalue_input(name, value)
        return binding

    def run(self, outputs: Iterable[str], feeds: Mapping[str, NDArray[Any] | OnDevice]) -> list[NDArray[Any]]:
        """Outputs of the names asked for; `feeds` holds the other inputs, and may stand in for constants.

        What lies on the device is taken as it is; arrays are copied there first.

        Raises:
            ProviderError: a GPU failed, or has no room.
            SurroundingsError: memory or threads are short.
        """
        with running(self._subject, self._provider):
            binding = self.binding(feeds)
            for name, fed in feeds.items():
                if isinstance(fed, OnDevice):
                    where = self._provider.memory, self._provider.device
                    binding.bind_input(name, *where, fed.dtype, fed.shape, fed.pointer)
                else:
                    binding.bind_cpu_input(name, np.asarray(fed, order="C"))
            for name in outputs:
                binding.bind_output(name, "cpu")
            self.session.run_with_iobinding(binding)
            return [np.asarray(value) for value in binding.copy_outputs_to_cpu()]
