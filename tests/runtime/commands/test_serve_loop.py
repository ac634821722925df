"""`lightpage serve` with what keeps a device calibrated: the flight recorder and self-calibration."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from lightpage.errors import InvalidInputError
from lightpage.recording.reader import Recording
from runtime.acquisition.recording import RecordingSource
from runtime.client.client import LightpageClient
from runtime.commands import serve as serve_module
from runtime.commands.serve import serve
from runtime.decoding.decoder import Decoder
from runtime.errors import UnconfirmedPageError
from tests.runtime import toy
from tests.runtime.commands.test_commands import Served


def test_lost_pages_of_a_served_device_are_kept(toy_zip: Path, tmp_path: Path) -> None:
    toy.write_toy_recording(tmp_path / "lost.h5", toy.ToyDevice((60.0, 170.0)), 16, 4)
    served = Served(
        *("--bundle", toy_zip, "--source", f"recording:{tmp_path / 'lost.h5'}"),
        *("--calibration-page", "2", "--calibration-page", "3"),
        *("--flight-recorder", tmp_path / "flight", "--flight-recorder-pages", "2"),
    )
    try:
        with LightpageClient(served.target(), timeout_s=20) as client:
            for page in range(3):
                with pytest.raises(UnconfirmedPageError):
                    client.read_page(page)
        status, _, err = served.end(signal.SIGTERM)
        assert status == 0, err
    finally:
        served.process.kill()
        served.process.wait()
    kept = sorted((tmp_path / "flight").iterdir())
    assert len(kept) == 2
    with Recording.open(kept[0]) as recording:
        assert recording.pages == 1


@pytest.mark.parametrize(
    ("options", "match"),
    [
        (["--self-calibrate"], "a source that shows known pages"),
        (["--calibration-page", "1", "--calibration-page", "2"], "a source that shows known pages"),
        (["--source", "simulator:bench", "--calibration-page", "1"], "at least 2 that differ"),
    ],
)
def test_self_calibration_that_cannot_work_is_refused_at_once(options: list[str], match: str) -> None:
    with pytest.raises(InvalidInputError, match=match):
        CliRunner().invoke(serve, options, standalone_mode=False, catch_exceptions=False)


def test_a_source_that_has_nothing_to_show_is_told(
    decoder: Decoder, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    source = RecordingSource.__new__(RecordingSource)
    monkeypatch.setattr(serve_module, "open_source", lambda name: source)
    monkeypatch.setattr(source, "check_against", lambda profile: None)
    source.name = "camera:mine.toml"
    for count in (None, 3, 0):
        monkeypatch.setattr(source, "page_count", lambda count=count: count)
        assert not caplog.records
        serve_module._source("camera:mine.toml", None, decoder)
    assert "camera:mine.toml shows pages and has none" in caplog.text


def test_a_thread_that_does_not_end_does_not_keep_the_process() -> None:
    program = """
import threading
from runtime.commands import serve
serve._REST_S = 0.1
threading.Thread(target=threading.Event().wait, args=(300,), name="hung").start()
serve._leave_the_rest()
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert (done.returncode, "hung was still at work" in done.stderr) == (0, True), done.stderr
