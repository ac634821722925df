"""`lightpage serve`: what it refuses at once, what it warns of, and what keeps it from ending."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest
from click.testing import CliRunner

from lightpage.errors import InvalidInputError
from runtime.acquisition.recording import RecordingSource
from runtime.commands.serve import checked_source, leave_the_rest, serve
from runtime.decoding.decoder import Decoder
from tests.runtime import toy


@pytest.mark.parametrize(
    ("options", "subject"),
    [
        (["--self-calibrate"], "option --self-calibrate"),
        (["--calibration-page", "1", "--calibration-page", "2"], "option --calibration-page"),
        (["--source", "simulator:bench", "--calibration-page", "1"], "option --calibration-page"),
    ],
)
def test_self_calibration_that_cannot_work_is_refused_at_once(options: list[str], subject: str) -> None:
    with pytest.raises(InvalidInputError) as error:
        CliRunner().invoke(serve, options, standalone_mode=False, catch_exceptions=False)
    assert subject in str(error.value)


@pytest.mark.parametrize(("count", "told"), [(None, 0), (3, 0), (0, 1)])
def test_a_source_that_has_nothing_to_show_is_told(
    count: int | None,
    told: int,
    decoder: Decoder,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    toy.write_toy_recording(tmp_path / "R.h5", toy.ToyDevice(), 16, 1)
    monkeypatch.setattr(RecordingSource, "page_count", lambda _: count)
    with checked_source(f"recording:{tmp_path / 'R.h5'}", None, decoder) as source:
        assert [source.name in record.getMessage() for record in caplog.records] == [True] * told


def test_a_thread_that_does_not_end_does_not_keep_the_process(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    end, left = threading.Event(), list[int]()
    threads = [threading.current_thread()]
    threads += [threading.Thread(target=end.wait, name=name, daemon=name == "daemon") for name in ("daemon", "hung")]
    for thread in threads[1:]:
        thread.start()
    monkeypatch.setattr(threading, "enumerate", lambda: threads)
    leave_the_rest(0.05, left.append)
    assert left == [0]
    assert "while hung was" in caplog.text
    end.set()
    leave_the_rest(60.0, left.append)
    assert left == [0]
