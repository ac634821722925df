"""No package imports what lies above it, the runtime serves without torch, and nothing is sent to anybody."""

from __future__ import annotations

import ast
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
TORCH = {"torch", "lightning", "onnx", "onnxscript"}
FORBIDDEN = {
    "optics": {*TORCH, "onnxruntime", "grpc", "train", "export", "runtime", "tests", "benchmarks"},
    "train": {"onnx", "onnxruntime", "grpc", "export", "runtime", "tests", "benchmarks"},
    "runtime": {*TORCH, "train", "export", "tests", "benchmarks"},
    "export": {"tests", "benchmarks"},
}
"""By package, what none of its files may import: optics <- train <- export and optics <- runtime <- export."""


def files(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def imports(path: Path) -> set[str]:
    """Top-level names of everything that a file imports, inside functions too."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found.add(node.module.partition(".")[0])
    return found


@pytest.mark.parametrize("package", FORBIDDEN)
def test_no_file_imports_what_lies_above_it(package: str) -> None:
    found = files(package)
    assert len(found) >= 5
    offenders = {str(path.relative_to(ROOT)): bad for path in found if (bad := imports(path) & FORBIDDEN[package])}
    assert offenders == {}


def test_one_module_alone_imports_onnxruntime() -> None:
    assert [path.name for path in files("runtime") if "onnxruntime" in imports(path)] == ["ort.py"]


SERVE = """
import sys
from pathlib import Path
from runtime.bundle.bundle import Bundle
from runtime.client.client import LightpageClient
from runtime.service.dataplane import DataPlane
from runtime.decoding.decoder import Decoder
from runtime.service.recalibrator import Recalibrator
from runtime.service.registry import ModelRegistry
from runtime.rpc.server import LightpageServer
from runtime.acquisition.sources import open_source
import importlib, pkgutil, runtime
for module in pkgutil.iter_modules(runtime.__path__):
    importlib.import_module("runtime." + module.name)
plane = DataPlane(ModelRegistry(Decoder(Bundle.open(sys.argv[1]))), open_source("recording:" + sys.argv[2]))
server = LightpageServer(plane, Recalibrator(plane, None))
with server, LightpageClient(server.target) as client:
    page = client.read_page(want_written=True)
    assert (page.symbols == page.written).all()
loaded = {name.partition(".")[0] for name in sys.modules}
bad = loaded & {"torch", "lightning", "onnx", "onnxscript", "train", "export", "tests"}
assert not bad, bad
import os
import signal
assert os.environ["ORT_DISABLE_TELEMETRY"] == "1"
print("served")
"""


def test_importing_everything_and_serving_a_page_loads_no_torch(toy_zip: Path, tmp_path: Path) -> None:
    from tests.runtime import toy

    toy.write_toy_recording(tmp_path / "r.h5", toy.ToyDevice(), 16, 1)
    run = subprocess.run(
        [sys.executable, "-c", SERVE, str(toy_zip), str(tmp_path / "r.h5")],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert run.stdout.strip() == "served", run.stderr


def test_telemetry_is_off_before_onnxruntime_loads_whatever_the_environment_says() -> None:
    script = """
import builtins, os, sys
load = builtins.__import__
def watch(name, *rest):
    if name.partition(".")[0] == "onnxruntime" and "seen" not in globals():
        globals()["seen"] = os.environ.get("ORT_DISABLE_TELEMETRY")
    return load(name, *rest)
builtins.__import__ = watch
import runtime.execution.session
print(seen)
"""
    environment = {**os.environ, "ORT_DISABLE_TELEMETRY": "0"}
    run = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, env=environment, capture_output=True, text=True, timeout=60
    )
    assert run.stdout.strip() == "1", run.stderr


NO_INTERNET = """
import ctypes, platform, socket, struct, sys
number = {"x86_64": 41, "aarch64": 198}[platform.machine()]  # of the system call socket(family, ...)
# A filter in the kernel: whoever asks for a socket of the internet's families ends this process.
load, equal, answer = 0x20, 0x15, 0x06
steps = [
    (load, 0, 0, 0), (equal, 0, 3, number),
    (load, 0, 0, 16), (equal, 2, 0, socket.AF_INET), (equal, 1, 0, socket.AF_INET6),
    (answer, 0, 0, 0x7FFF0000), (answer, 0, 0, 0x80000000),
]
program = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *step) for step in steps))
class Filter(ctypes.Structure):
    _fields_ = [("length", ctypes.c_ushort), ("steps", ctypes.c_void_p)]
filter = Filter(len(steps), ctypes.addressof(program))
libc = ctypes.CDLL(None)
if libc.prctl(38, 1, 0, 0, 0) or libc.prctl(22, 2, ctypes.byref(filter), 0, 0):
    sys.exit("no filters here")
if sys.argv[1] == "control":
    socket.socket(socket.AF_INET)
from runtime.bundle.bundle import Bundle
from runtime.decoding.decoder import Decoder
decoder = Decoder(Bundle.open(sys.argv[1]))
decoder.decode(decoder.bundle.golden.pair, 16)
print("decoded")
"""


def without_internet(argument: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", NO_INTERNET, argument]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60)
    if done.stderr.strip() == "no filters here":
        pytest.skip("this kernel lets no process filter its own system calls")
    return done


def test_decoding_asks_for_no_connection_to_anybody(toy_zip: Path) -> None:
    assert without_internet("control").returncode == -signal.SIGSYS
    done = without_internet(str(toy_zip))
    assert (done.returncode, done.stdout.strip()) == (0, "decoded"), done.stderr
