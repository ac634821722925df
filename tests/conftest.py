"""Fixtures that several packages' tests share because they are dear."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

import pytest
from click.testing import CliRunner

from optics.cli import simulate
from optics.profile import Profile, load_profile
from optics.registration.calibration import Calibration, load_calibration

BENCH_PAGES = 3


@pytest.fixture(scope="session")
def bench_recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three pages of the realistic bench device, M = 16."""
    out = _shared_folder(tmp_path_factory) / "bench.h5"
    with open(f"{out}.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # one worker makes it, the others wait and take it
        if not out.exists():
            arguments = f"--profile bench --pages {BENCH_PAGES} --levels 16 --seed 11 --out {out}"
            CliRunner().invoke(simulate, arguments.split(), standalone_mode=False, catch_exceptions=False)
    return out


@pytest.fixture(scope="session")
def bench_calibration(
    bench_recording: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Profile, Path, Calibration]:
    """The bench profile, a recording of a realistic device, and that device's calibration, made by the command."""
    from train.cli_calibrate import calibrate

    out = _shared_folder(tmp_path_factory) / "bench-calibration.toml"
    with open(f"{out}.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not out.exists():
            arguments = f"--profile bench --recording {bench_recording} --out {out} --json {out}.json"
            CliRunner().invoke(calibrate, arguments.split(), standalone_mode=False, catch_exceptions=False)
    return load_profile("bench"), bench_recording, load_calibration(out)


def _shared_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that all workers of one run of the tests share."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "shared"
    folder.mkdir(exist_ok=True)
    return folder
