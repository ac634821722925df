"""Progress where stderr is no terminal: plain lines, now and then."""

from __future__ import annotations

import pytest
import tqdm.std

from lightpage.cli import progress_bar
from tests.clock import HandClock


def test_progress_is_plain_lines_now_and_then_where_stderr_is_no_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = HandClock()
    monkeypatch.setattr(tqdm.std, "time", clock.now)
    with progress_bar.percent_bar() as progress:
        for step in range(4):
            clock.advance(progress_bar.LINE_S)
            progress("fit", step / 4)
    for _ in progress_bar.Bars().track(range(30), "pages", "page", None, 0, lambda: "AIR 5"):
        clock.advance(progress_bar.LINE_S / 10 + 1e-3)
    told = capsys.readouterr()
    assert told.out == ""
    lines = [line for line in told.err.splitlines() if line]
    assert lines[0].startswith("lightpage: fit: ")
    assert any(line.startswith("lightpage: done: 100% after 02:00") for line in lines)
    pages = [line for line in lines if line.startswith("lightpage: pages: ")]
    assert 2 <= len(pages) <= 4
    assert pages[0].endswith(", AIR 5")
    assert "\r" not in told.err


def test_short_work_says_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    assert list(progress_bar.Bars().track(range(3), "pages", "page", None, 0, lambda: "")) == [0, 1, 2]
    assert capsys.readouterr().err.strip() == ""
