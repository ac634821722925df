"""What `lightpage` and `runtime` offer by name, and what whoever only calls a service need not load."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path

import pytest
from grpc_tools import protoc

from tests.runtime import toy

ROOT = Path(__file__).resolve().parents[1]
HEAVY = {"onnxruntime", "scipy", "matplotlib", "h5py", "pydantic", "torch", "PIL", "reedsolo", "click", "google_crc32c"}


@pytest.mark.parametrize("package", ["lightpage", "lightpage.codec", "runtime"])
def test_every_name_of_a_door_is_there(package: str) -> None:
    module = importlib.import_module(package)
    assert [name for name in module.__all__ if getattr(module, name, None) is None] == []
    with pytest.raises(AttributeError):
        _ = module.nothing_of_that_name


def test_a_notebook_opens_decodes_and_measures_in_four_lines(toy_zip: Path, tmp_path: Path) -> None:
    toy.write_toy_recording(tmp_path / "r.h5", toy.ToyDevice(), 16, 1)
    names = {"path": str(tmp_path / "r.h5"), "bundle": str(toy_zip)}
    script = """
import lightpage, runtime
recording, decoder = lightpage.Recording.open(path), runtime.load(bundle)
page = decoder.decode(recording.frames(0), recording.levels)
air = lightpage.measure(page.phase, page.concentration, recording.symbols(0), recording.levels).air_bits_per_symbol
"""
    exec(script, names)
    assert 2 < float(names["air"]) < 4


def test_a_callers_own_stubs_work_beside_the_installed_package_and_the_client_is_light(tmp_path: Path) -> None:
    """Made by plain protoc, they lie in a folder `lightpage/v1` of the caller's."""
    made = ["protoc", f"-I{ROOT / 'proto'}", f"--python_out={tmp_path}", "lightpage/v1/lightpage.proto"]
    assert protoc.main(made) == 0
    script = """
import runtime.client.client
print(*sorted({name.partition(".")[0] for name in sys.modules}))
import lightpage, runtime
from runtime.pb.lightpage.v1 import lightpage_pb2 as ours
from lightpage.v1 import lightpage_pb2 as theirs
theirs.DecodeReply.FromString(ours.DecodeReply(rows=3).SerializeToString())
print(theirs.__file__, lightpage.Recording, runtime.LightpageClient)
"""
    for first in ("lightpage, runtime", "lightpage.v1.lightpage_pb2"):
        code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import {first}\n{script}"
        done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr
        loaded, theirs = done.stdout.splitlines()
        assert {"grpc", "numpy", "runtime"} <= set(loaded.split())
        assert set(loaded.split()) & HEAVY == set()
        assert str(tmp_path) in theirs
