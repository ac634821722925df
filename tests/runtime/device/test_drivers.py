"""Drivers of other packages: the examples of the documents work, and what is wrong with one is said."""

import itertools
import re
import sys
import time
import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from lightpage.device.profile import load_profile
from lightpage.errors import InvalidInputError, Reason, SourceError
from lightpage.page.symbols import random_symbols
from lightpage.runtime.device.acquisition.camera_devices import open_camera
from lightpage.runtime.device.acquisition.source import open_source
from tests.runtime.device.acquisition.lab import reason_of

TEXT = (Path(__file__).parents[3] / "docs" / "guides" / "drivers.md").read_text("utf-8")
DECLARED, DEVICE = (text for text in re.findall(r"```toml\n(.*?)```", TEXT, re.DOTALL))
MOST_LINES = 80
SHAPE = load_profile("bench").frame_shape


class Absent(Exception):
    pass


class Camera:
    """Exposes what the panel shows, at each pulse."""

    there: dict[str, "Camera"] = {}  # noqa: RUF012

    def __init__(self, serial: str, rows: int, columns: int) -> None:
        self.serial, self.images, self.numbers = serial, list[SimpleNamespace](), itertools.count(1)
        self.there[serial] = self

    def start(self, trigger: str) -> None:
        self.images.clear()

    stop = release = lambda self: None

    def expose(self) -> None:
        told = {"number": next(self.numbers), "clock_s": 7 + time.monotonic(), "host_s": time.time()}
        self.images.append(SimpleNamespace(pixels=Panel.seen, complete=True, exposure_s=1e-4, **told))

    def next_image(self, timeout_s: float) -> SimpleNamespace | None:
        return self.images.pop(0) if self.images else None


class PulseBox:
    def __init__(self, port: str) -> None:
        if port != "COM3":
            raise Absent

    def pulse(self) -> None:
        for camera in Camera.there.values():
            camera.expose()


class Panel:
    seen = np.zeros(SHAPE, np.uint8)

    def display(self, greys: np.ndarray) -> None:
        Panel.seen = np.full(SHAPE, 1 + greys[0, 0] // 2, np.uint8)


class Device:
    """Cameras that are there once, and lose their second pair."""

    starts = iter((True, False))

    def __init__(self, rest: str) -> None:
        self.running, self.number, self.blocked = False, 0, False

    def start(self) -> bool:
        self.running = next(self.starts)
        return self.running

    def stop(self) -> None:
        self.running = False

    def block_signal(self, blocked: bool) -> None:
        self.blocked = blocked

    def show(self, symbols: np.ndarray | None) -> None:
        assert symbols is None

    def take_pair(self, timeout_s: float) -> tuple[SimpleNamespace, SimpleNamespace] | None:
        assert self.running
        self.number += 1
        if self.number == 2:
            return None
        frame = np.full(SHAPE, 50 if self.blocked else 100, np.uint8)
        told = {"number": self.number, "serial": "V1", "clock_s": 1.0, "host_s": 2.0}
        return SimpleNamespace(pixels=frame, **told), SimpleNamespace(pixels=frame + 1, **told)


@pytest.fixture(autouse=True)
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[EntryPoint]:
    """The package of the documents, beside the library of a maker; what is added is installed too."""
    sdk = ModuleType("vendor_sdk")
    vars(sdk).update(Absent=Absent, Camera=Camera, PulseBox=PulseBox, Panel=Panel, Device=Device)
    monkeypatch.setitem(sys.modules, "vendor_sdk", sdk)
    groups = tomllib.loads(DECLARED)["project"]["entry-points"]
    points = [EntryPoint(name, value, group) for group, named in groups.items() for name, value in named.items()]
    (tmp_path / "my_package").mkdir()
    for point, code in zip(points, re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL), strict=True):
        assert code.count("\n") < MOST_LINES
        (tmp_path / point.module.replace(".", "/")).with_suffix(".py").write_text(code)
        monkeypatch.delitem(sys.modules, point.module, raising=False)
    monkeypatch.delitem(sys.modules, "my_package", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    found = lambda group: [point for point in points if point.group == group]  # noqa: E731
    monkeypatch.setattr("lightpage.runtime.device.plugins.entry_points", found)
    return points


def test_camera_trigger_and_modulator_of_a_vendor_take_pages(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(DEVICE)
    with open_camera(str(tmp_path / "mine.toml")) as source:
        source.pages.append(random_symbols(load_profile("bench"), 16, 2, np.random.default_rng(0)), 16)
        shots = [source.shot(page=page) for page in (0, 1)]
        assert [camera.name for camera in source.cameras] == ["in-phase camera (17)", "quadrature camera (18)"]
    for shot in shots:
        assert shot.symbols is not None
        assert shot.infos is not None
        assert shot.infos[0].serial == "17"
        assert (shot.pair.quadrature == 1 + (int(shot.symbols[0, 0]) * 256 // 16) // 2).all()
    (tmp_path / "mine.toml").write_text(DEVICE.replace("COM3", "COM4"))
    with pytest.raises(SourceError, match="COM4"):
        open_camera(str(tmp_path / "mine.toml")).arm()


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('driver = "vendor"', 'driver = "vendr"', "vendr"),
        ('driver = "vendor"', 'driver = "broken"', "ZeroDivisionError"),
        ('driver = "vendor"', 'driver = "bare"', "frame_numbers"),
        ('serial = "17"', "number = 17", "KeyError"),
    ],
)
def test_what_is_wrong_with_a_driver_is_said(
    old: str, new: str, told: str, installed: list[EntryPoint], tmp_path: Path
) -> None:
    for name, code in (("broken", "1 / 0"), ("bare", "def Camera(*_): pass")):
        (tmp_path / "my_package" / f"{name}.py").write_text(code)
        installed.append(EntryPoint(name, f"my_package.{name}:Camera", "lightpage.cameras"))
    (tmp_path / "mine.toml").write_text(DEVICE.replace(old, new, 1))
    with pytest.raises(InvalidInputError) as caught:
        open_camera(str(tmp_path / "mine.toml"))
    assert caught.value.subject.endswith("mine.toml: in_phase")
    assert told in caught.value.got
    assert told != "vendr" or "vendor" in caught.value.expected


def test_the_source_of_a_vendor_works() -> None:
    lost: list[int] = []
    with open_source("vendor:7") as source:
        source.on_lost = lambda page, error: lost.append(page)
        shot = source.shot()
        assert shot.infos is not None
        assert [info.frame_id for info in shot.infos] == [1, 1]
        assert shot.pair.quadrature[0, 0] == 101
        assert reason_of(source.shot) is Reason.MISSING_FRAME
        assert lost == [1]
        assert source.shot().page_index == 2
        references = source.references()
        assert references is not None
        assert references.in_phase[0, 0] == 50
    with pytest.raises(SourceError, match=r"^vendor"):
        open_source("vendor:7").arm()
