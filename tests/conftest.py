"""Fixtures that several packages' tests share because they are dear."""

import fcntl
import os
import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from lightpage.calibration.calibrate import Registered
from lightpage.calibration.document import Calibration
from lightpage.calibration.parameters import NAMES
from lightpage.cli.simulate import simulate
from lightpage.device.state import Device
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.bundle.manifest import TWIN
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.simulator.true_optics import true_parameters
from tests.lightpage.command import run
from tests.lightpage.small import EXPLAINED, small_profile
from tests.runtime import toy

pytest_plugins = ["pytester", "tests.skips", "tests.own_network"]

SMALL_PAGES = 8


def pytest_configure() -> None:
    """Let Ctrl-C reach programs that tests start, even if the tests run in the background, where shells ignore it."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def small_device(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Options that name a small device's profile, its recording of eight pages and its (right) calibration."""

    def make(folder: Path) -> None:
        folder.mkdir()
        profile, state = small_profile(), Device()
        (folder / "small.toml").write_text(profile.to_toml())
        made = f"--profile {folder}/small.toml --pages {SMALL_PAGES} --seed 4 --out {folder}/R.h5"
        run(simulate, *made.split())
        truth, turn = true_parameters(profile, state), state.homodyne.turn_rad
        right = Registered(truth, np.ones(len(NAMES)), turn, 0.0, 0.5, 1.0, 0.5, goodness=EXPLAINED)
        Calibration.from_registered(right, profile, ["0" * 64]).save(folder / "C.toml")

    folder = _made_once(tmp_path_factory, "small-device", make)
    named = {"--profile": "small.toml", "--recording": "R.h5", "--calibration": "C.toml"}
    return [word for option, name in named.items() for word in (option, str(folder / name))]


@pytest.fixture(scope="session")
def small_run(small_device: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A training of two passes on the small device: four pages to train on, two to validate, two left."""

    def make(out: Path) -> None:
        from lightpage.train.commands.train import train

        size = "--channels 12 --blocks 1 --synthetic-pages 0 --validation-share 0.25 --test-share 0.25 --steps 120"
        run(train, *small_device, *size.split(), "--out", out)

    return _made_once(tmp_path_factory, "small-run", make)


@pytest.fixture(scope="session")
def small_bundle(small_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bundle of that training, version small-1."""

    def make(out: Path) -> None:
        from lightpage.export.from_run import export_run

        export_run(small_run, out, version="small-1", batches=True)

    return _made_once(tmp_path_factory, "small.zip", make)


@pytest.fixture
def ready_twin(small_bundle: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let exports take the graph of the small profile's rays from a bundle, since making it takes half a minute."""
    from lightpage.export import from_run

    graph = Bundle.open(small_bundle).files[TWIN]
    monkeypatch.setattr(from_run, "twin_onnx", lambda twin: graph)


@pytest.fixture(scope="session")
def ray_run(small_device: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A few steps of the published decoder by rays on the small device."""

    def make(out: Path) -> None:
        from lightpage.train.commands.train import train

        run(train, *small_device[2:], "--localizer", "ray", "--channels", 4, "--steps", 12, "--out", out)

    return _made_once(tmp_path_factory, "ray-run", make)


def _made_once(tmp_path_factory: pytest.TempPathFactory, name: str, make: Callable[[Path], None]) -> Path:
    """A file or folder that one worker makes, and that all workers of one run of the tests share."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "shared"
    (folder / "unfinished").mkdir(parents=True, exist_ok=True)
    out = folder / name
    with open(f"{out}.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not out.exists():
            make(folder / "unfinished" / name)
            (folder / "unfinished" / name).rename(out)
    return out


@pytest.fixture(scope="session")
def toy_zip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return toy.write_toy_bundle(tmp_path_factory.mktemp("bundle") / "toy.zip")


@pytest.fixture(scope="session")
def toy_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return toy.write_toy_bundle(tmp_path_factory.mktemp("bundle") / "toy")


@pytest.fixture(scope="session")
def decoder(toy_zip: Path) -> Decoder:
    return Decoder(Bundle.open(toy_zip), threads=1)
