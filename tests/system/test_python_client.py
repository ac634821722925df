"""The Python client by itself: it needs little of what a service needs, and does what the service's own does."""

from __future__ import annotations

import inspect
import json
import re
import shutil
import subprocess
import sys
from importlib.metadata import Distribution
from pathlib import Path

import numpy as np
import pytest

from runtime.client.client import LightpageClient
from runtime.decoding.decoder import Decoder
from runtime.errors import ERRORS
from runtime.rpc.server import LightpageServer
from runtime.service.dataplane import DataPlane
from runtime.service.recalibrator import Recalibrator
from runtime.service.registry import ModelRegistry
from tests.runtime import toy

ROOT = Path(__file__).resolve().parents[2]
DEPENDENCIES = {"googleapis-common-protos", "grpcio", "numpy", "protobuf", "typing-extensions"}
LOADED = {"google", "grpc", "lightpage_client", "numpy", "typing_extensions"}
TOOLS = {"pip", "setuptools", "lightpage-client"}


def run(*command: str | Path, cwd: Path, timeout_s: float = 120) -> str:
    done = subprocess.run(
        [str(word) for word in command],
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=timeout_s,
        stdin=subprocess.DEVNULL,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of what the client is built of: a build leaves its traces."""
    copy = tmp_path_factory.mktemp("client")
    for name in ("lightpage", "runtime", "clients/python"):
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__", "build", "*.egg-info"))
    shutil.copy(ROOT / "pyproject.toml", copy)
    return copy


FOREIGN = ["lightpage", "runtime", "onnxruntime", "scipy", "matplotlib", "h5py", "pydantic", "torch", "click"]
DECODE = f"""
import sys
sys.path.insert(0, sys.argv[4])
sys.modules.update(dict.fromkeys({FOREIGN}))  # as if they were not there
import inspect, json
import numpy as np
from lightpage_client import FramePair, LightpageClient
from lightpage_client.errors import FrameError
from lightpage_client.runtime.errors import ERRORS
frames, said = np.load(sys.argv[2]), ""
with LightpageClient(sys.argv[1], timeout_s=60) as client:
    version = client.describe().model.version
    page = client.decode(FramePair(frames[0], frames[1]), 16)
    try:
        client.decode(FramePair(frames[1], frames[0]), 16)
    except FrameError as error:
        said = type(error).__name__
np.save(sys.argv[3], page.symbols)
members = inspect.getmembers(LightpageClient, inspect.isfunction)
print(json.dumps({{
    "answers": [version, page.model_version, said],
    "loaded": sorted({{
        name.partition(".")[0] for name, module in sys.modules.items()
        if "site-packages" in (getattr(module, "__file__", None) or "")
    }}),
    "methods": {{name: list(inspect.signature(member).parameters) for name, member in members}},
    "errors": sorted(ERRORS),
}}))
"""


def decodes(python: str | Path, installed: Path, toy_zip: Path, tmp_path: Path) -> None:
    """See the installed client decode a page of a service."""
    symbols = toy.symbols_of(16, 3)[0]
    pair = toy.ToyDevice(seed=3).page(symbols, 16, 0.7)
    np.save(tmp_path / "frames.npy", np.stack([pair.in_phase, pair.quadrature]))
    plane = DataPlane(ModelRegistry(Decoder.load(toy_zip, threads=1)), toy.ToySource(toy.ToyDevice()))
    with LightpageServer(plane, Recalibrator(plane, None, tmp_path)) as server:
        files = (tmp_path / "frames.npy", tmp_path / "symbols.npy", installed)
        told = json.loads(run(python, "-I", "-c", DECODE, server.target, *files, cwd=tmp_path))
    assert told["answers"] == ["toy-1", "toy-1", "FramesDisagreeError"]
    assert (np.load(tmp_path / "symbols.npy") == symbols).all()
    # grpc loads those of its sisters that are there; what begins with _ is the environment's own.
    assert {name for name in told["loaded"] if not name.startswith(("grpc_", "_"))} <= LOADED
    own = inspect.getmembers(LightpageClient, inspect.isfunction)
    assert told["methods"] == {name: list(inspect.signature(member).parameters) for name, member in own}
    assert told["errors"] == sorted(ERRORS)


def test_it_decodes_a_page_as_the_services_own_client_does(source: Path, toy_zip: Path, tmp_path: Path) -> None:
    installed = tmp_path / "installed"
    pip = (sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index")
    run(*pip, "--target", installed, "./clients/python", cwd=source)
    (about,) = installed.glob("*.dist-info")
    needed = Distribution.at(about).requires or []
    assert {re.split(r"[<>=!~;\[ ]", one)[0] for one in needed} == DEPENDENCIES - {"typing-extensions"}
    decodes(sys.executable, installed, toy_zip, tmp_path)


@pytest.mark.long  # pip fetches and installs for ten seconds what the test above names and hides
def test_it_installs_with_its_dependencies_and_nothing_else(source: Path, toy_zip: Path, tmp_path: Path) -> None:
    run(sys.executable, "-m", "venv", tmp_path / "environment", cwd=tmp_path)
    python = tmp_path / "environment" / "bin" / "python"
    pip = (python, "-m", "pip", "install", "--quiet", "--constraint", ROOT / "constraints.txt")
    run(*pip, "./clients/python", cwd=source, timeout_s=500)
    listed = json.loads(run(python, "-m", "pip", "list", "--format", "json", cwd=tmp_path))
    names = {one["name"].lower().replace("_", "-") for one in listed} - TOOLS
    assert names <= DEPENDENCIES
    decodes(python, tmp_path / "nowhere", toy_zip, tmp_path)
