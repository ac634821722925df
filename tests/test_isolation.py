"""No package imports what lies above it, the runtime serves without torch, and nothing is sent to anybody."""

from __future__ import annotations

import ast
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

from tests.skips import NO_FILTERS

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("lightpage", "train", "runtime", "export", "analysis")
ROOMS = (
    "lightpage.clock",
    "lightpage.errors",
    "lightpage.failures",
    "lightpage.progress",
    "lightpage.files",
    "lightpage.temporary",
    "lightpage.words",
    "lightpage.von_mises",
    "lightpage.device",
    "lightpage.page",
    "lightpage.metrics",
    "lightpage.codec",
    "lightpage.waves",
    "lightpage.recording",
    "lightpage.calibration",
    "lightpage.simulator",
    "lightpage.cli",
    "lightpage",
    "train.processes",
    "train.models",
    "train.data",
    "train.fitting",
    "train.published",
    "train.runs",
    "train.trainers",
    "train.commands",
    "train",
    "runtime.pb",
    "runtime.errors",
    "runtime.helper_process",
    "runtime.bundle",
    "runtime.execution",
    "runtime.decoding",
    "runtime.cameras",
    "runtime.trigger",
    "runtime.modulator",
    "runtime.acquisition",
    "runtime.virtual_device",
    "runtime.bulk",
    "runtime.recalibration",
    "runtime.wire",
    "runtime.client",
    "runtime.scaling",
    "runtime.service",
    "runtime.identity",
    "runtime.console",
    "runtime.rpc",
    "runtime.demo",
    "runtime.commands",
    "runtime",
    "export",
    "analysis.foreign_device",
    "analysis.studies",
    "analysis.report",
    "analysis.comparison",
    "analysis.codec",
    "analysis.speed",
    "analysis.tracking",
    "analysis.hardware",
    "analysis.results",
    "analysis",
)
"""From the ground up: a room may use itself and those before it."""
TORCH = {"torch", "lightning", "onnx", "onnxscript"}
FORBIDDEN = {
    "lightpage": {*TORCH, "onnxruntime", "grpc", "train", "export", "runtime", "analysis", "tests"},
    "train": {"onnx", "onnxruntime", "grpc", "export", "runtime", "analysis", "tests"},
    "runtime": {*TORCH, "train", "export", "analysis", "tests"},
    "export": {"analysis", "tests"},
    "analysis": {"tests"},
}
"""By package, what none of its files may use: lightpage <- {train, runtime} <- export <- analysis."""
COMMANDS_ONLY = {"click", "rich", "tqdm"}
"""Terminals are the business of commands and of what they share."""


def files(package: str) -> list[Path]:
    return [path for path in sorted((ROOT / package).rglob("*.py")) if "pb" not in path.parts]


def uses(path: Path) -> set[str]:
    """Dotted names of everything that a file uses: imports, inside functions too, and modules named in strings.

    A string names a module if it is nothing but its dotted name, with an attribute after a colon or not: as for
    `importlib`, `python -m`, and entry points.
    """
    found = set()
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            named = node.value.removeprefix("-m").strip().partition(":")[0]
            if named.partition(".")[0] in PACKAGES and "." in named and is_module(named):
                found.add(named)
    return found


def is_module(name: str) -> bool:
    path = ROOT.joinpath(*name.split("."))
    return path.with_suffix(".py").is_file() or (path / "__init__.py").is_file()


def room(name: str) -> str:
    """The innermost room of `ROOMS` that a dotted name lies in; the name itself where it lies in none."""
    parts = name.split(".")
    return next((".".join(parts[:n]) for n in range(len(parts), 0, -1) if ".".join(parts[:n]) in ROOMS), name)


def offenders(bad: Callable[[Path, str], bool], paths: Iterable[Path]) -> dict[str, list[str]]:
    found = {str(path.relative_to(ROOT)): sorted(name for name in uses(path) if bad(path, name)) for path in paths}
    return {path: names for path, names in found.items() if names}


@pytest.mark.parametrize("package", FORBIDDEN)
def test_no_file_uses_a_package_above_it(package: str) -> None:
    found = files(package)
    assert len(found) >= 5
    assert offenders(lambda _, name: name.partition(".")[0] in FORBIDDEN[package], found) == {}


@pytest.mark.parametrize("package", PACKAGES)
def test_no_room_uses_one_above_it(package: str) -> None:
    def above(path: Path, name: str) -> bool:
        here, there = room(".".join(path.relative_to(ROOT).with_suffix("").parts)), room(name)
        return name.partition(".")[0] == package and ROOMS.index(there) > ROOMS.index(here)

    assert offenders(above, files(package)) == {}


def test_every_file_lies_in_a_room() -> None:
    names = (".".join(path.relative_to(ROOT).with_suffix("").parts) for package in PACKAGES for path in files(package))
    assert [name for name in names if room(name) not in ROOMS] == []


@pytest.mark.parametrize("package", ["lightpage", "train", "runtime"])
def test_commands_alone_know_of_terminals(package: str) -> None:
    rooms = ("lightpage.cli", "train.commands", "runtime.commands")
    others = [p for p in files(package) if room(".".join(p.relative_to(ROOT).with_suffix("").parts)) not in rooms]
    assert offenders(lambda _, name: name.partition(".")[0] in COMMANDS_ONLY, others) == {}


def test_one_module_alone_imports_onnxruntime() -> None:
    found = offenders(lambda _, name: name.partition(".")[0] == "onnxruntime", files("runtime"))
    assert list(found) == ["runtime/execution/session.py"]


def test_a_client_leaves_the_names_of_the_open_inference_protocol_alone() -> None:
    """A process has room for one package of messages named `inference`: that of another client, where there is one."""
    below = [path for room in ("wire", "client") for path in sorted((ROOT / "runtime" / room).rglob("*.py"))]
    assert offenders(lambda _, name: name.startswith("runtime.pb.inference"), files("runtime"))
    assert offenders(lambda _, name: name.startswith("runtime.pb.inference"), below) == {}


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
for module in pkgutil.walk_packages(runtime.__path__, "runtime."):
    importlib.import_module(module.name)
plane = DataPlane(ModelRegistry(Decoder(Bundle.open(sys.argv[1]))), open_source("recording:" + sys.argv[2]))
server = LightpageServer(plane, Recalibrator(plane, None))
with server, LightpageClient(server.target) as client:
    page = client.read_page(want_written=True)
    assert (page.symbols == page.written).all()
loaded = {name.partition(".")[0] for name in sys.modules}
bad = loaded & {"torch", "lightning", "onnx", "onnxscript", "opentelemetry", "ray", "train", "export", "tests"}
assert not bad, bad
import os
import signal
assert os.environ["ORT_DISABLE_TELEMETRY"] == "1"
print("served")
"""


def test_importing_everything_and_serving_a_page_loads_no_torch_and_no_tracing(toy_zip: Path, tmp_path: Path) -> None:
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
        pytest.skip(NO_FILTERS)
    return done


def test_decoding_asks_for_no_connection_to_anybody(toy_zip: Path) -> None:
    assert without_internet("control").returncode == -signal.SIGSYS
    done = without_internet(str(toy_zip))
    assert (done.returncode, done.stdout.strip()) == (0, "decoded"), done.stderr


def test_every_folder_of_code_is_a_package() -> None:
    """Setuptools leaves a folder without `__init__.py` out of the image, and here nobody would notice."""
    folders = {path.parent for package in PACKAGES for path in files(package)}
    assert [str(folder.relative_to(ROOT)) for folder in folders if not (folder / "__init__.py").exists()] == []
