"""Pages of a source become a recording: gone on with after an interruption, every lost shot noted."""

import json
from collections.abc import Callable
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from lightpage.cli import main as cli_main
from lightpage.cli.main import EXIT_ERROR, EXIT_LOST, lightpage
from lightpage.errors import LostShotError, Reason
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import FrameInfo
from lightpage.recording.pages import PagesWriter
from lightpage.recording.pixels.black_level import DarkFrame
from lightpage.recording.reader import Recording
from lightpage.runtime.commands.archives import record as module
from lightpage.runtime.device.acquisition.page_store import PageStore
from lightpage.runtime.device.acquisition.source import SHOT_S, FrameSource, Shot
from tests.runtime import toy

Record = Callable[..., int]
"""Records from a source with options, and gives the exit status."""


class Bench(FrameSource):
    """A source with a modulator, whose shots of some pages are lost."""

    name, bit_depth, levels, frame_shape = "toy:bench", 8, 16, toy.SHAPE
    profile = toy.PROFILE

    def __init__(self, lost: dict[int, int] | None = None, interrupted: int | None = None) -> None:
        self.device, self.lost, self.interrupted = toy.ToyDevice(), dict(lost or {}), interrupted
        self.at_shot: Callable[[], object] = lambda: None
        self.armed, self.shots = False, 0

    def arm(self) -> None:
        self.armed = True

    def disarm(self) -> None:
        self.armed = False

    def shot(self, timeout_s: float = SHOT_S, page: int | None = None) -> Shot:
        assert self.armed
        page = page or 0
        self.shots += 1
        self.at_shot()
        if page == self.interrupted:
            raise KeyboardInterrupt
        if self.lost.get(page, 0) > 0:
            self.lost[page] -= 1
            error = LostShotError("I: frame", "none", "one", Reason.MISSING_FRAME)
            self.on_lost(page, error)
            raise error
        symbols = toy.symbols_of(16, page)[0] if self.pages is None else self.pages[page]
        info = FrameInfo("CAM", page + 1, 100.0 + page, 1e9 + page, "Mono8", 2e-4)
        return Shot(self.device.page(symbols, 16, 0.1), page, symbols, None, (info, info))

    def references(self) -> FramePair:
        self.operator("block the signal beam")
        return self.device.references()

    def dark_frames(self) -> tuple[DarkFrame, DarkFrame]:
        dark = DarkFrame(np.full(toy.SHAPE, 2, np.uint8), 2, np.array([[1, 2]]))
        return dark, dark

    def show_pages(self, pages: PageStore) -> None:
        self.pages = pages


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What the operator was asked."""
    asked: list[str] = []
    monkeypatch.setattr(module, "ask_operator", asked.append)
    return asked


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "r.h5"


@pytest.fixture
def record(asked: list[str], out: Path, monkeypatch: pytest.MonkeyPatch) -> Record:
    def recorded(source: FrameSource, *options: object) -> int:
        monkeypatch.setattr(module, "open_source", lambda spec: source)
        words = ["record", "--source", "toy:x", "--out", str(out), *map(str, options)]
        return cli_main.run(lightpage, words)

    return recorded


def written(path: Path, *numbers: int, code: dict[str, object] | None = None) -> Path:
    with PagesWriter(path, toy.PROFILE, 16, code or {}) as writer:
        writer.append(np.stack([toy.symbols_of(16, number)[0] for number in numbers]))
    return path


def begins_with(path: Path, number: int) -> bool:
    with Recording.open(path) as recording:
        return bool((recording.symbols(0) == toy.symbols_of(16, number)[0]).all())


def pages_of(path: Path) -> int:
    with Recording.open(path) as recording:
        return recording.pages


def test_a_recording_holds_what_the_cameras_say(record: Record, asked: list[str], out: Path, tmp_path: Path) -> None:
    source, figures = Bench(lost={1: 2}), tmp_path / "r.json"
    pages = written(tmp_path / "pages.h5", 5, 6, 7, code={"levels": 16})
    assert record(source, "--symbols", pages, "--json", figures) == 0
    assert (asked, source.armed) == (["block the signal beam"], False)
    with Recording.open(out) as recording:
        assert (recording.pages, recording.header.code_text) == (3, '{"levels": 16}')
        assert (recording.symbols(2) == toy.symbols_of(16, 7)[0]).all()
        infos = recording.cameras.frame_infos(0)
        assert infos is not None
        assert infos[1] == FrameInfo("CAM", 1, 100.0, 1e9, "Mono8", 2e-4)
        dark, hot = recording.cameras.dark_frames(), recording.cameras.hot_pixels()
        assert dark is not None
        assert hot is not None
        assert (dark.in_phase[0, 0], hot[0].tolist()) == (2, [[1, 2]])
        assert [(loss.page, loss.reason) for loss in recording.cameras.losses()] == [(1, "MISSING_FRAME")] * 2
    told = json.loads(figures.read_text())
    assert (told["pages"], told["shots_lost"], told["pages_repeated"]) == (3, 2, 2)
    assert told["losses"] == {"MISSING_FRAME": 2}


def test_an_interrupted_recording_is_gone_on_with(record: Record, out: Path) -> None:
    assert record(Bench(interrupted=2), "--pages", 4) == 130
    assert not out.exists()
    source = Bench()
    source.device.offsets = (10, 12)  # other reference frames than before
    assert record(source, "--pages", 4) == 0
    assert (source.shots, pages_of(out)) == (2, 4)


def test_a_page_that_no_shot_gives_ends_the_recording_and_keeps_the_others(
    record: Record, out: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert record(Bench(lost={1: 99}), "--pages", 3) == EXIT_LOST
    told = capsys.readouterr().err.splitlines()
    assert sum("warning: page 1:" in line for line in told) == module.ATTEMPTS
    assert told[-1].startswith("lightpage: error: page 1 of toy:bench: I: frame:")
    assert record(Bench(), "--pages", 3) == 0
    with Recording.open(out) as recording:
        assert len(recording.cameras.losses()) == module.ATTEMPTS


def test_random_pages_are_shown_for_none(record: Record, out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = Bench()
    monkeypatch.setattr(source, "page_count", lambda: 0 if source.pages is None else len(source.pages))
    assert record(source, "--pages", 2) == 0
    with Recording.open(out) as recording:
        assert np.mean(recording.symbols(0) != recording.symbols(1)) > 0.8


def test_what_cannot_be_recorded_is_refused_before_anything_is_connected(
    record: Record, out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pages, source, empty = written(tmp_path / "pages.h5", 1, 2), Bench(), Bench()
    monkeypatch.setattr(empty, "page_count", lambda: 0)
    assert record(Bench(interrupted=2), "--pages", 3) == 130
    capsys.readouterr()
    for shown, options, named in (
        (source, (), "neither --pages"),
        (source, ("--pages", 2, "--profile", "bench"), "toy:bench"),
        (source, ("--symbols", pages, "--pages", 3), "--pages: got 3"),
        (empty, (), "--symbols: got none"),
        (Bench(), ("--pages", 1), "2 pages already"),
    ):
        monkeypatch.setattr(shown, "arm", lambda: pytest.fail("armed"))
        assert record(shown, *options) == EXIT_ERROR
        assert named in capsys.readouterr().err
    out.write_text("there")
    assert record(source, "--pages", 2) == EXIT_ERROR
    assert "--force" in capsys.readouterr().err
    assert source.shots == 0


def test_pages_of_another_file_are_neither_mixed_in_nor_thrown_away(record: Record, out: Path, tmp_path: Path) -> None:
    first, other = written(tmp_path / "first.h5", 1, 2, 3), written(tmp_path / "other.h5", 4, 5, 6)
    assert record(Bench(interrupted=2), "--symbols", first) == 130
    assert record(source := Bench(), "--symbols", other) == EXIT_ERROR
    assert source.shots == 0
    assert record(source := Bench(), "--symbols", first) == 0
    assert (source.shots, begins_with(out, 1)) == (1, True)
    out.unlink()
    assert record(Bench(interrupted=2), "--symbols", first) == 130
    assert record(Bench(), "--symbols", other, "--force") == 0
    assert begins_with(out, 4)


def test_a_recording_that_is_finished_meanwhile_is_not_replaced(
    record: Record, out: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = Bench()
    source.at_shot = lambda: out.write_text("there")
    assert record(source, "--pages", 1) == EXIT_ERROR
    assert f"{out}.partial" in capsys.readouterr().err
    assert out.read_text() == "there"
    assert record(Bench(), "--pages", 2, "--force") == 0
    assert pages_of(out) == 2


def test_a_second_run_beside_the_first_is_refused_at_once(record: Record, out: Path) -> None:
    source, second = Bench(), Bench()
    ends = []
    source.at_shot = lambda: ends.append(record(second, "--pages", 1))
    assert record(source, "--pages", 1) == 0
    assert (ends, second.shots, pages_of(out)) == ([EXIT_ERROR], 0, 1)


def test_frames_without_a_page_that_stay_lost_are_lost_data(record: Record, monkeypatch: pytest.MonkeyPatch) -> None:
    lost = Mock(side_effect=LostShotError("I: frame", "none", "one", Reason.MISSING_FRAME))
    monkeypatch.setattr(source := Bench(), "dark_frames", lost)
    assert record(source, "--pages", 1) == EXIT_LOST
