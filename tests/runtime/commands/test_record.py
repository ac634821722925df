"""Pages of a source become a recording: gone on with after an interruption, every lost shot noted."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from lightpage.cli import main as cli_main
from lightpage.cli.main import EXIT_ERROR, EXIT_LOST, lightpage
from lightpage.recording.black_level import DarkFrame
from lightpage.recording.layout import FrameInfo
from lightpage.recording.pages import PagesWriter
from lightpage.recording.reader import Recording
from runtime.acquisition.page_store import PageStore
from runtime.acquisition.source import SHOT_S, FrameSource, Shot
from runtime.commands import record as module
from runtime.errors import LostShotError, Reason
from tests.runtime import toy


def run(*arguments: str | Path) -> int:
    return cli_main.run(lightpage, ["record", *map(str, arguments)])


class Bench(FrameSource):
    """A source with a modulator, whose shots of some pages are lost."""

    name, bit_depth, levels, frame_shape = "toy:bench", 8, 16, toy.SHAPE
    profile = toy.PROFILE

    def __init__(self, lost: dict[int, int] | None = None, interrupted: int | None = None) -> None:
        self.device, self.lost, self.interrupted = toy.ToyDevice(), dict(lost or {}), interrupted
        self.armed = False
        self.shots = 0

    def arm(self) -> None:
        self.armed = True

    def disarm(self) -> None:
        self.armed = False

    def shot(self, timeout_s: float = SHOT_S, page: int | None = None) -> Shot:
        assert self.armed
        page = page or 0
        self.shots += 1
        if page == self.interrupted:
            raise KeyboardInterrupt
        if self.lost.get(page, 0) > 0:
            self.lost[page] -= 1
            error = LostShotError("I: frame", "none", "one", Reason.MISSING_FRAME)
            self.on_lost(page, error)
            raise error
        symbols = toy.symbols_of(16, page)[0] if self.pages is None else self.pages[page]
        info = FrameInfo("CAM", page + 1, 100.0 + page, 1e9 + page, "Mono8", None if page else 2e-4)
        return Shot(self.device.page(symbols, 16, 0.1), page, symbols, None, (info, info))

    def references(self) -> object:  # type: ignore[override]
        self.operator("block the signal beam")
        return self.device.references()

    def dark_frames(self) -> tuple[DarkFrame, DarkFrame]:
        dark = DarkFrame(np.full(toy.SHAPE, 2, np.uint8), 2, np.array([[1, 2]]))
        return dark, dark

    def show_pages(self, pages: PageStore) -> None:
        self.pages = pages


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    asked: list[str] = []
    monkeypatch.setattr(module, "_ask", asked.append)
    return asked


def given(monkeypatch: pytest.MonkeyPatch, source: FrameSource) -> None:
    monkeypatch.setattr(module, "open_source", lambda spec: source)


def test_a_recording_holds_what_the_cameras_say(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bench: list[str]
) -> None:
    with PagesWriter(tmp_path / "pages.h5", toy.PROFILE, 16, {"levels": 16}) as writer:
        writer.append(np.stack([toy.symbols_of(16, number)[0] for number in (5, 6, 7)]))
    source = Bench(lost={1: 2})
    given(monkeypatch, source)
    out, figures = tmp_path / "r.h5", tmp_path / "r.json"
    assert run("--source", "toy:x", "--symbols", tmp_path / "pages.h5", "--out", out, "--json", figures) == 0
    assert bench == ["block the signal beam"]
    assert not source.armed
    with Recording.open(out) as recording:
        assert recording.pages == 3
        assert recording.code_text == '{"levels": 16}'
        symbols = recording.symbols(2)
        assert symbols is not None
        assert (symbols == toy.symbols_of(16, 7)[0]).all()
        infos = recording.frame_infos(0)
        assert infos is not None
        assert infos[1] == FrameInfo("CAM", 1, 100.0, 1e9, "Mono8", 2e-4)
        later = recording.frame_infos(2)
        assert later is not None
        assert later[0].exposure_s is None
        dark, hot = recording.dark_frames(), recording.hot_pixels()
        assert dark is not None
        assert dark.in_phase[0, 0] == 2
        assert hot is not None
        assert hot[0].tolist() == [[1, 2]]
        assert [(loss.page, loss.reason) for loss in recording.losses()] == [(1, "MISSING_FRAME")] * 2
    told = json.loads(figures.read_text())
    assert (told["pages"], told["shots_lost"], told["pages_repeated"]) == (3, 2, 2)
    assert told["losses"] == {"MISSING_FRAME": 2}


def test_an_interrupted_recording_is_gone_on_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bench: list[str]
) -> None:
    out = tmp_path / "r.h5"
    given(monkeypatch, Bench(interrupted=2))
    assert run("--source", "toy:x", "--pages", "4", "--out", out) == 130
    assert not out.exists()
    source = Bench()
    source.device.offsets = (10, 12)  # type: ignore[attr-defined]  # other reference frames than before
    given(monkeypatch, source)
    assert run("--source", "toy:x", "--pages", "4", "--out", out) == 0
    assert source.shots == 2
    with Recording.open(out) as recording:
        assert recording.pages == 4


def test_a_page_that_no_shot_gives_ends_the_recording_and_keeps_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bench: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "r.h5"
    given(monkeypatch, Bench(lost={1: 99}))
    assert run("--source", "toy:x", "--pages", "3", "--out", out) == EXIT_LOST
    assert "page 1 of toy:bench" in capsys.readouterr().err
    given(monkeypatch, Bench())
    assert run("--source", "toy:x", "--pages", "3", "--out", out) == 0
    with Recording.open(out) as recording:
        assert len(recording.losses()) == module.ATTEMPTS


def test_what_cannot_be_recorded_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bench: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "r.h5"
    given(monkeypatch, Bench())
    assert run("--source", "toy:x", "--out", out) == EXIT_ERROR
    assert "neither --pages nor" in capsys.readouterr().err
    assert run("--source", "toy:x", "--pages", "2", "--profile", "bench", "--out", out) == EXIT_ERROR
    assert "frames and pages" in capsys.readouterr().err
    out.write_text("there")
    assert run("--source", "toy:x", "--pages", "2", "--out", out) == EXIT_ERROR
    assert "--force" in capsys.readouterr().err


def test_any_source_can_be_recorded(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    toy.write_toy_recording(tmp_path / "in.h5", toy.ToyDevice(), 16, 3)
    assert run("--source", f"recording:{tmp_path / 'in.h5'}", "--pages", "2", "--out", tmp_path / "out.h5") == 0
    with Recording.open(tmp_path / "in.h5") as before, Recording.open(tmp_path / "out.h5") as after:
        assert (before.frames(1).in_phase == after.frames(1).in_phase).all()
        assert after.frame_infos(0) is None


def test_an_operator_is_asked_at_a_terminal_only(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(Exception, match="no terminal"):
        module._ask("block the signal beam")
