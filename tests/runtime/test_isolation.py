"""The runtime serves without torch, imports nothing above it, and sends no telemetry."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FILES = [path for path in sorted((ROOT / "runtime").rglob("*.py"))]
FORBIDDEN = {"torch", "lightning", "onnx", "onnxscript", "train", "export"}


def imports(path: Path) -> set[str]:
    """Top-level names of everything that a file imports, inside functions too."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found.add(node.module.partition(".")[0])
    return found


def test_no_file_of_the_runtime_imports_torch_or_what_lies_above() -> None:
    assert len(FILES) > 20
    offenders = {str(path.relative_to(ROOT)): bad for path in FILES if (bad := imports(path) & FORBIDDEN)}
    assert offenders == {}


def test_one_module_alone_imports_onnxruntime() -> None:
    assert [path.name for path in FILES if "onnxruntime" in imports(path)] == ["ort.py"]


SERVE = """
import sys
from pathlib import Path
from runtime.bundle import Bundle
from runtime.client import LightpageClient
from runtime.dataplane import DataPlane
from runtime.decoder import Decoder
from runtime.recalibrator import Recalibrator
from runtime.registry import ModelRegistry
from runtime.server import LightpageServer
from runtime.sources import open_source
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
import runtime.ort
print(seen)
"""
    environment = {**os.environ, "ORT_DISABLE_TELEMETRY": "0"}
    run = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, env=environment, capture_output=True, text=True, timeout=60
    )
    assert run.stdout.strip() == "1", run.stderr
