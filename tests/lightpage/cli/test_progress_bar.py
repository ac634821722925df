"""Progress where stderr is no terminal: plain lines, now and then."""

from __future__ import annotations

import time

import pytest

from lightpage.cli import progress_bar


def test_progress_is_plain_lines_where_stderr_is_no_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress_bar, "LINE_S", 0.05)
    with progress_bar.percent_bar() as progress:
        for step in range(4):
            time.sleep(0.06)
            progress("fit", step / 4)
    for _ in progress_bar.Bars().track(range(3), "pages", "page", None, 0, lambda: "AIR 5"):
        time.sleep(0.06)
    told = capsys.readouterr()
    assert told.out == ""
    lines = [line for line in told.err.splitlines() if line]
    assert lines[0].startswith("lightpage: fit: ")
    assert any(line.startswith("lightpage: done: 100% after ") for line in lines)
    assert any(line.startswith("lightpage: pages: ") and line.endswith("left, AIR 5") for line in lines)
    assert "\r" not in told.err


def test_short_work_says_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    assert list(progress_bar.Bars().track(range(3), "pages", "page", None, 0, lambda: "")) == [0, 1, 2]
    assert capsys.readouterr().err.strip() == ""
