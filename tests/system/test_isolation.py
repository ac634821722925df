"""The runtime serves without torch, nothing is sent to anybody, and setuptools finds every folder of code."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.runtime import toy
from tests.skips import NO_FILTERS

ROOT = Path(__file__).resolve().parents[2]
SERVE = """
import builtins, importlib, os, pkgutil, sys
load, telemetry = builtins.__import__, []
def watch(name, *rest, **named):
    if name.partition(".")[0] == "onnxruntime" and "onnxruntime" not in sys.modules:
        telemetry.append(os.environ.get("ORT_DISABLE_TELEMETRY"))
    return load(name, *rest, **named)
builtins.__import__ = watch
import lightpage.runtime
for module in pkgutil.walk_packages(lightpage.runtime.__path__, "lightpage.runtime."):
    importlib.import_module(module.name)
from lightpage.runtime.device.acquisition.source import open_source
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.client.client import LightpageClient
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.service.server.server import LightpageServer
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.jobs.recalibrator import Recalibrator
from lightpage.runtime.service.models.models import Models
plane = DataPlane(Models(Decoder(Bundle.open(sys.argv[1]))), open_source("recording:" + sys.argv[2]))
server = LightpageServer(plane, Recalibrator(plane, None))
with server, LightpageClient(server.target) as client:
    page = client.pages.read(want_written=True)
    assert (page.symbols == page.written).all()
loaded = {name.partition(".")[0] for name in sys.modules} | {".".join(name.split(".")[:2]) for name in sys.modules}
bad = loaded & {"torch", "lightning", "onnx", "onnxscript", "opentelemetry", "ray", "tests"}
bad |= loaded & {"lightpage.train", "lightpage.export", "lightpage.study", "lightpage.report", "runtime"}
assert not bad, bad
assert telemetry and set(telemetry) == {"1"}, telemetry
"""
NO_INTERNET = """
import ctypes, os, platform, signal, socket, struct, sys
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
child = os.fork()
if child == 0:
    socket.socket(socket.AF_INET)
    os._exit(0)
assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGSYS
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.decoding.decoder import Decoder
decoder = Decoder(Bundle.open(sys.argv[1]))
decoder.decode(decoder.bundle.golden.pair, 16)
"""


def run(script: str, *arguments: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", script, *map(str, arguments)]
    environment = {**os.environ, "ORT_DISABLE_TELEMETRY": "0"}
    return subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=120)


def test_importing_everything_and_serving_a_page_loads_no_torch_and_turns_telemetry_off(
    toy_zip: Path, tmp_path: Path
) -> None:
    toy.write_toy_recording(tmp_path / "r.h5", toy.ToyDevice(), 16, 1)
    done = run(SERVE, toy_zip, tmp_path / "r.h5")
    assert done.returncode == 0, done.stderr


def test_decoding_asks_for_no_connection_to_anybody(toy_zip: Path) -> None:
    done = run(NO_INTERNET, toy_zip)
    if done.stderr.strip() == "no filters here":
        pytest.skip(NO_FILTERS)
    assert done.returncode == 0, done.stderr


def test_every_folder_of_code_is_a_package() -> None:
    """Setuptools leaves a folder without `__init__.py` out of the image, and here nobody would notice."""
    walked = list(os.walk(ROOT / "lightpage", followlinks=True))
    folders = [Path(folder) for folder, _, names in walked if any(name.endswith(".py") for name in names)]
    assert [str(folder.relative_to(ROOT)) for folder in folders if not (folder / "__init__.py").exists()] == []
