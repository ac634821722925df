"""What `lightpage` and `runtime` offer by name."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from grpc_tools import protoc

from tests.runtime import toy

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.parametrize("package", ["lightpage", "lightpage.codec", "runtime"])
def test_every_name_of_a_door_is_there(package: str) -> None:
    module = importlib.import_module(package)
    assert [name for name in module.__all__ if getattr(module, name, None) is None] == []
    with pytest.raises(AttributeError, match="nothing_of_that_name"):
        _ = module.nothing_of_that_name


def test_a_notebook_opens_decodes_and_measures_in_five_lines(toy_zip: Path, tmp_path: Path) -> None:
    toy.write_toy_recording(tmp_path / "r.h5", toy.ToyDevice(), 16, 1)
    script = f"""
import lightpage, runtime
recording, decoder = lightpage.Recording.open({str(tmp_path / "r.h5")!r}), runtime.load({str(toy_zip)!r})
page = decoder.decode(recording.frames(0), recording.levels)
print(lightpage.measure(page.phase, page.concentration, recording.symbols(0), recording.levels).air_bits_per_symbol)
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert np.isfinite(float(done.stdout))
    assert float(done.stdout) > 2


def test_a_callers_own_stubs_work_beside_the_installed_package(tmp_path: Path) -> None:
    """Made by plain protoc, they lie in a folder `lightpage/v1` of the caller's."""
    assert (
        protoc.main(["protoc", f"-I{ROOT / 'proto'}", f"--python_out={tmp_path}", "lightpage/v1/lightpage.proto"]) == 0
    )
    script = """
import lightpage, runtime
from runtime.pb.lightpage.v1 import lightpage_pb2 as ours
from lightpage.v1 import lightpage_pb2 as theirs
theirs.DecodeReply.FromString(ours.DecodeReply(rows=3).SerializeToString())
print(theirs.__file__, lightpage.Recording, runtime.LightpageClient)
"""
    for order in ("lightpage, runtime", "lightpage.v1.lightpage_pb2"):
        done = subprocess.run(
            [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import {order}\n{script}"],
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=60,
        )
        assert done.returncode == 0, done.stderr
        assert str(tmp_path) in done.stdout
