"""Fixtures that several packages' tests share because they are dear."""

from __future__ import annotations

import fcntl
import os
import signal
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from lightpage.calibration.calibrate import Registered
from lightpage.calibration.document import Calibration, load_calibration
from lightpage.calibration.parameters import NAMES
from lightpage.cli.simulate import simulate
from lightpage.device.profile import Profile, load_profile
from lightpage.device.state import Device
from lightpage.simulator.true_optics import true_parameters
from runtime.bundle.bundle import Bundle
from runtime.decoding.decoder import Decoder
from tests.lightpage.small import small_profile
from tests.runtime import toy

pytest_plugins = ["pytester", "tests.skips", "tests.own_network"]

BENCH_PAGES = 3
SMALL_PAGES = 8


def pytest_configure() -> None:
    """Let Ctrl-C reach programs that tests start, even if the tests run in the background, where shells ignore it."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


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
    from train.commands.calibrate import calibrate

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


@pytest.fixture(scope="session")
def small_device(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Options that name a small device's profile, its recording of eight pages and its (right) calibration."""
    folder = tmp_path_factory.mktemp("device")
    profile, state = small_profile(), Device()
    (folder / "small.toml").write_text(profile.to_toml())
    made = f"--profile {folder}/small.toml --pages {SMALL_PAGES} --seed 4 --out {folder}/R.h5"
    CliRunner().invoke(simulate, made.split(), standalone_mode=False, catch_exceptions=False)
    truth, turn = true_parameters(profile, state), state.homodyne.turn_rad
    right = Registered(truth, np.ones(len(NAMES)), turn, 0.0, 0.5, 1.0, 0.5)
    Calibration.from_registered(right, profile, ["0" * 64]).save(folder / "C.toml")
    named = {"--profile": "small.toml", "--recording": "R.h5", "--calibration": "C.toml"}
    return [word for option, name in named.items() for word in (option, str(folder / name))]


@pytest.fixture(scope="session")
def toy_zip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return toy.write_toy_bundle(tmp_path_factory.mktemp("bundle") / "toy.zip")


@pytest.fixture(scope="session")
def toy_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return toy.write_toy_bundle(tmp_path_factory.mktemp("bundle") / "toy")


@pytest.fixture(scope="session")
def decoder(toy_zip: Path) -> Decoder:
    return Decoder(Bundle.open(toy_zip), threads=1)
