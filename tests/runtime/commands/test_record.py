"""Pages of a source become a recording: gone on with after an interruption, every lost shot noted."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
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
        self.at_shot = lambda: None
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
        self.at_shot()
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


def written(path: Path, *numbers: int, code: dict[str, object] | None = None) -> Path:
    with PagesWriter(path, toy.PROFILE, 16, code or {}) as writer:
        writer.append(np.stack([toy.symbols_of(16, number)[0] for number in numbers]))
    if code is None:
        with h5py.File(path, "r+") as file:
            del file.attrs["code"]
    return path


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
    assert run("--source", f"recording:{tmp_path / 'in.h5'}", "--pages", "4", "--out", tmp_path / "o.h5") == EXIT_ERROR
    assert "at most the 3 pages of recording:" in capsys.readouterr().err


def test_an_operator_is_asked_at_a_terminal_only(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(Exception, match="no terminal"):
        module._ask("block the signal beam")


@pytest.mark.parametrize("code", [None, {"volume": 1}])
def test_pages_of_another_file_are_neither_mixed_in_nor_thrown_away(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    bench: list[str],
    capsys: pytest.CaptureFixture[str],
    code: dict[str, object] | None,
) -> None:
    first = written(tmp_path / "first.h5", 1, 2, 3, code=code)
    other = written(tmp_path / "other.h5", 4, 5, 6, code=code and {"volume": 2})
    out = tmp_path / "r.h5"
    given(monkeypatch, Bench(interrupted=2))
    assert run("--source", "toy:x", "--symbols", first, "--out", out) == 130
    assert f"2 pages are in {out}.partial; the same command goes on from there" in capsys.readouterr().err
    given(monkeypatch, source := Bench())
    assert run("--source", "toy:x", "--symbols", other, "--out", out) == EXIT_ERROR
    told = capsys.readouterr().err
    assert "r.h5.partial: got 2 pages of other symbols, wanted the same --symbols, another name, or --force" in told
    assert source.shots == 0
    given(monkeypatch, source := Bench())
    assert run("--source", "toy:x", "--symbols", first, "--out", out) == 0
    assert source.shots == 1
    with Recording.open(out) as recording:
        assert (recording.symbols(2) == toy.symbols_of(16, 3)[0]).all()
    out.unlink()
    given(monkeypatch, Bench(interrupted=2))
    assert run("--source", "toy:x", "--symbols", first, "--out", out) == 130
    given(monkeypatch, Bench())
    assert run("--source", "toy:x", "--symbols", other, "--out", out, "--force") == 0
    with Recording.open(out) as recording:
        assert (recording.symbols(0) == toy.symbols_of(16, 4)[0]).all()


def test_a_recording_that_is_finished_meanwhile_is_not_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bench: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "r.h5"
    given(monkeypatch, source := Bench())
    source.at_shot = lambda: out.write_text("there")  # type: ignore[assignment,return-value]
    assert run("--source", "toy:x", "--pages", "1", "--out", out) == EXIT_ERROR
    assert f"a file that exists by now, wanted a new name, or --force; the pages are in {out}.partial" in (
        capsys.readouterr().err
    )
    assert out.read_text() == "there"
    given(monkeypatch, source := Bench())
    monkeypatch.setattr(source, "references", lambda: (out.write_text("again"), source.device.references())[1])
    out.unlink()
    assert run("--source", "toy:x", "--pages", "2", "--out", out) == EXIT_ERROR
    assert out.read_text() == "again"
    assert source.shots == 0
    given(monkeypatch, Bench())
    assert run("--source", "toy:x", "--pages", "2", "--out", out, "--force") == 0
    with Recording.open(out) as recording:
        assert recording.pages == 2


def test_a_second_run_beside_the_first_is_refused_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bench: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "r.h5"
    second = Bench()

    def again() -> None:
        given(monkeypatch, second)
        assert run("--source", "toy:x", "--pages", "1", "--out", out) == EXIT_ERROR

    given(monkeypatch, source := Bench())
    source.at_shot = again
    assert run("--source", "toy:x", "--pages", "1", "--out", out) == 0
    assert "another process is writing now" in capsys.readouterr().err
    assert second.shots == 0
    with Recording.open(out) as recording:
        assert recording.pages == 1


def test_numbers_of_pages_are_checked_before_anything_is_connected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bench: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    out, pages = tmp_path / "r.h5", written(tmp_path / "pages.h5", 1, 2)

    def refused(source: FrameSource, *options: str | Path) -> str:
        given(monkeypatch, source)
        monkeypatch.setattr(source, "arm", lambda: pytest.fail("armed"))
        assert run("--source", "toy:x", "--out", out, *options) == EXIT_ERROR
        return capsys.readouterr().err

    told = refused(Bench(), "--symbols", pages, "--pages", "3")
    assert f"--pages: got 3, wanted at most the 2 pages of --symbols {pages}" in told
    empty = Bench()
    monkeypatch.setattr(empty, "page_count", lambda: 0)
    assert "--symbols: got none, and toy:bench has no pages to show" in refused(empty, "--pages", "3")
    given(monkeypatch, Bench(interrupted=2))
    assert run("--source", "toy:x", "--symbols", pages, "--pages", "2", "--out", out) == 0
    out.unlink()
    given(monkeypatch, Bench(interrupted=1))
    assert run("--source", "toy:x", "--pages", "3", "--out", out) == 130
    assert "1 page is in" in capsys.readouterr().err
    given(monkeypatch, Bench(interrupted=2))
    assert run("--source", "toy:x", "--pages", "3", "--out", out) == 130
    assert "2 pages already there" in refused(Bench(), "--pages", "1")


def test_a_lost_page_is_told_once_with_its_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bench: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    class Named(Bench):
        def shot(self, timeout_s: float = SHOT_S, page: int | None = None) -> Shot:
            try:
                return super().shot(timeout_s, page)
            except LostShotError as error:
                raise error.about(f"page {page} of {self.name}") from None

    for kind in (Bench, Named):
        given(monkeypatch, kind(lost={0: 99}))
        assert run("--source", "toy:x", "--pages", "1", "--out", tmp_path / "r.h5") == EXIT_LOST
        told = capsys.readouterr().err.splitlines()
        assert told[:2] == ["lightpage: dark frames", "lightpage: reference frames"]
        assert told[2] == "lightpage: warning: page 0: shot lost (MISSING_FRAME): I: frame: none"
        assert told[-1].startswith("lightpage: error: page 0 of toy:bench: I: frame: got none, wanted one (MISSING")


def test_frames_without_a_page_that_stay_lost_are_lost_data(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bench: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    def lost() -> None:
        raise LostShotError("I: frame", "none", "one", Reason.MISSING_FRAME)

    given(monkeypatch, source := Bench())
    monkeypatch.setattr(source, "dark_frames", lost)
    assert run("--source", "toy:x", "--pages", "1", "--out", tmp_path / "r.h5") == EXIT_LOST
    assert "I: frame: got none, wanted one (MISSING_FRAME)" in capsys.readouterr().err


def test_one_page_is_one_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bench: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    given(monkeypatch, Bench(lost={0: 1}))
    assert run("--source", "toy:x", "--pages", "1", "--out", tmp_path / "r.h5") == 0
    assert "1 page of 16 levels; 1 shot lost (1 MISSING_FRAME)" in capsys.readouterr().out
