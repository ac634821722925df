"""Names that the packages offer, and the Python client by itself, which needs little of what a service needs."""

import importlib
import json
import re
import shutil
import subprocess
import sys
from importlib.metadata import Distribution
from pathlib import Path

import numpy as np
import pytest
from grpc_tools import protoc

from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.jobs.recalibrator import Recalibrator
from lightpage.runtime.service.models.models import Models
from lightpage.runtime.service.server.server import LightpageServer
from tests.runtime import toy

ROOT = Path(__file__).resolve().parents[2]
NEEDED = {"googleapis-common-protos", "grpcio", "numpy", "protobuf"}
LOADED = {"google", "grpc", "lightpage_client", "numpy", "typing_extensions"}
HEAVY = {"onnxruntime", "scipy", "matplotlib", "h5py", "pydantic", "torch", "PIL", "reedsolo", "click", "google_crc32c"}


def run(*command: str | Path, cwd: Path) -> str:
    done = subprocess.run([str(word) for word in command], cwd=cwd, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("package", ["lightpage", "lightpage.codec"])
def test_every_name_of_a_door_is_there(package: str) -> None:
    module = importlib.import_module(package)
    assert [name for name in module.__all__ if getattr(module, name, None) is None] == []
    with pytest.raises(AttributeError):
        _ = module.nothing_of_that_name


def test_a_callers_own_stubs_work_beside_the_installed_package_and_the_client_is_light(tmp_path: Path) -> None:
    """Made by plain protoc, they lie in a folder `lightpage/v1` of the caller's."""
    made = ["protoc", f"-I{ROOT / 'proto'}", f"--python_out={tmp_path}", "lightpage/v1/lightpage.proto"]
    assert protoc.main(made) == 0
    script = """
import lightpage.runtime.client.client
print(*sorted({name.partition(".")[0] for name in sys.modules}))
import lightpage
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as ours
from lightpage.v1 import lightpage_pb2 as theirs
theirs.DecodeReply.FromString(ours.DecodeReply(rows=3).SerializeToString())
print(theirs.__file__, lightpage.Recording, lightpage.LightpageClient)
"""
    for first in ("lightpage", "lightpage.v1.lightpage_pb2"):
        code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import {first}\n{script}"
        loaded, theirs = run(sys.executable, "-c", code, cwd=ROOT).splitlines()
        assert {"grpc", "numpy", "lightpage"} <= set(loaded.split())
        assert set(loaded.split()) & HEAVY == set()
        assert str(tmp_path) in theirs


DECODE = f"""
import sys
sys.path.insert(0, sys.argv[4])
sys.modules.update(dict.fromkeys({["lightpage", *HEAVY]}))  # as if they were not there
import json
import numpy as np
from lightpage_client import FramePair, LightpageClient
from lightpage_client.errors import FrameError
frames, said = np.load(sys.argv[2]), ""
with LightpageClient(sys.argv[1], timeout_s=60) as client:
    version = client.describe().model.version
    page = client.frames.decode(FramePair(frames[0], frames[1]), 16)
    try:
        client.frames.decode(FramePair(frames[1], frames[0]), 16)
    except FrameError as error:
        said = type(error).__name__
np.save(sys.argv[3], page.symbols)
print(json.dumps({{
    "answers": [version, page.model_version, said],
    "loaded": sorted({{
        name.partition(".")[0] for name, module in sys.modules.items()
        if "site-packages" in (getattr(module, "__file__", None) or "")
    }}),
}}))
"""


def test_it_decodes_a_page_as_the_services_own_client_does(decoder: Decoder, tmp_path: Path) -> None:
    source, installed = tmp_path / "source", tmp_path / "installed"
    traces = shutil.ignore_patterns("__pycache__", "build", "*.egg-info")
    shutil.copytree(ROOT / "clients" / "python", source, ignore=traces)  # by itself, and builds leave traces
    pip = (sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index")
    run(*pip, "--target", installed, ".", cwd=source)
    (about,) = installed.glob("*.dist-info")
    assert {re.split(r"[<>=!~;\[ ]", one)[0] for one in Distribution.at(about).requires or []} == NEEDED

    symbols = toy.symbols_of(16, 3)[0]
    pair = toy.ToyDevice(seed=3).page(symbols, 16, 0.7)
    np.save(tmp_path / "frames.npy", np.stack([pair.in_phase, pair.quadrature]))
    plane = DataPlane(Models(decoder), toy.ToySource(toy.ToyDevice()))
    with LightpageServer(plane, Recalibrator(plane, None, tmp_path)) as server:
        files = (tmp_path / "frames.npy", tmp_path / "symbols.npy", installed)
        told = json.loads(run(sys.executable, "-I", "-c", DECODE, server.target, *files, cwd=tmp_path))
    assert told["answers"] == ["toy-1", "toy-1", "FramesDisagreeError"]
    assert (np.load(tmp_path / "symbols.npy") == symbols).all()
    # grpc loads those of its sisters that are there; what begins with _ is the environment's own.
    assert {name for name in told["loaded"] if not name.startswith(("grpc_", "_"))} <= LOADED
