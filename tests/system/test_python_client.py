"""The Python client by itself: it installs without what only a service needs, and does what the service's own does."""

from __future__ import annotations

import inspect
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from lightpage.errors import LightpageError
from runtime.client.client import LightpageClient
from runtime.decoding.decoder import Decoder
from runtime.errors import ERRORS
from runtime.rpc.server import LightpageServer
from runtime.service.dataplane import DataPlane
from runtime.service.recalibrator import Recalibrator
from runtime.service.registry import ModelRegistry, no_tracker
from tests.runtime import toy

ROOT = Path(__file__).resolve().parents[2]
DEPENDENCIES = ("googleapis-common-protos", "grpcio", "numpy", "protobuf", "typing-extensions")


def run(*command: str | Path, cwd: Path, timeout_s: float = 60) -> str:
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
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Python of a fresh environment with the client and its dependencies in it, and nothing else."""
    folder = tmp_path_factory.mktemp("client")
    source = folder / "source"
    for name in ("lightpage", "runtime", "clients/python"):  # a copy: a build leaves its traces
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__", "build", "*.egg-info"))
    shutil.copy(ROOT / "pyproject.toml", source)
    run(sys.executable, "-m", "venv", folder / "environment", cwd=folder)
    python = folder / "environment" / "bin" / "python"
    pip = (python, "-m", "pip", "install", "--quiet", "--constraint", ROOT / "constraints.txt")
    run(*pip, "./clients/python", cwd=source, timeout_s=400)
    listed = json.loads(run(python, "-m", "pip", "list", "--format", "json", cwd=folder))
    names = {one["name"].lower().replace("_", "-") for one in listed} - {"pip", "setuptools", "lightpage-client"}
    assert names <= set(DEPENDENCIES)
    return python


DECODE = """
import json, sys
import numpy as np
from lightpage_client import FramePair, LightpageClient, LightpageError
from lightpage_client.errors import FrameError
frames = np.load(sys.argv[2])
with LightpageClient(sys.argv[1], timeout_s=20) as client:
    description = client.describe()
    page = client.decode(FramePair(frames[0], frames[1]), 16)
    try:
        client.decode(FramePair(frames[1], frames[0]), 16)
    except FrameError as error:
        said = type(error).__name__
np.save(sys.argv[3], page.symbols)
foreign = {"lightpage", "runtime", "onnxruntime", "scipy", "matplotlib", "h5py", "pydantic", "torch"} & set(sys.modules)
print(json.dumps([description.model.version, page.model_version, said, sorted(foreign)]))
"""


def test_it_decodes_a_page_of_a_service(python: Path, toy_zip: Path, tmp_path: Path) -> None:
    symbols = toy.symbols_of(16, 3)[0]
    pair = toy.ToyDevice(seed=3).page(symbols, 16, 0.7)
    np.save(tmp_path / "frames.npy", np.stack([pair.in_phase, pair.quadrature]))
    plane = DataPlane(ModelRegistry(Decoder.load(toy_zip, threads=1), no_tracker), toy.ToySource(toy.ToyDevice()))
    with LightpageServer(plane, Recalibrator(plane, None, tmp_path)) as server:
        files = (tmp_path / "frames.npy", tmp_path / "symbols.npy")
        said = json.loads(run(python, "-I", "-c", DECODE, server.target, *files, cwd=tmp_path))
    assert said == ["toy-1", "toy-1", "FramesDisagreeError", []]
    assert (np.load(tmp_path / "symbols.npy") == symbols).all()


DESCRIBE = """
import inspect, json
from lightpage_client import LightpageClient
from lightpage_client.runtime.errors import ERRORS
members = inspect.getmembers(LightpageClient, inspect.isfunction)
print(json.dumps([{name: list(inspect.signature(member).parameters) for name, member in members}, sorted(ERRORS)]))
"""


def test_its_interface_is_that_of_the_services_own_client(python: Path, tmp_path: Path) -> None:
    methods, errors = json.loads(run(python, "-I", "-c", DESCRIBE, cwd=tmp_path))
    own = inspect.getmembers(LightpageClient, inspect.isfunction)
    assert methods == {name: list(inspect.signature(member).parameters) for name, member in own}
    assert errors == sorted(ERRORS)
    assert LightpageError.__name__ in errors
