"""What a bundle weighs and takes: every file is weighed, and memory is that of a process of its own."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from analysis.speed.footprint import main, measured
from lightpage.device.state import Device
from lightpage.errors import InvalidInputError, RecordingError
from lightpage.simulator.recording_job import RecordingJob
from runtime.bundle.manifest import DECODER, FIELD, GOLDEN, MANIFEST, PILOTS, TWIN
from tests.lightpage.small import small_profile


@pytest.mark.long
def test_every_file_is_weighed_and_pages_are_decoded_in_a_process_of_their_own(tmp_path: Path) -> None:
    profile, figures = tmp_path / "small.toml", tmp_path / "F.json"
    profile.write_text(small_profile().to_toml())
    asked = ["--profile", str(profile), "--decoder", "fast", "--pages", "2", "--threads", "1", "--json", str(figures)]
    output = CliRunner().invoke(main, asked, catch_exceptions=False, standalone_mode=False).output
    (bundle,) = json.loads(figures.read_text())["bundles"]
    assert {file["name"] for file in bundle["files"]} == {DECODER, FIELD, GOLDEN, MANIFEST, PILOTS, TWIN}
    stored = sum(file["stored_bytes"] for file in bundle["files"])
    assert 0 < bundle["zip_bytes"] - stored < 2000
    assert bundle["unpacked_bytes"] == sum(file["unpacked_bytes"] for file in bundle["files"])
    assert (len(bundle["loading"]["pages_s"]), len(bundle["decoding"]["pages_s"])) == (0, 2)
    assert bundle["loading"]["peak_bytes"] > 20e6
    assert "median" in output


def test_memory_is_not_that_of_the_process_that_asks() -> None:
    code = "from analysis.speed.footprint_process import peak_bytes; print(peak_bytes())"
    held = np.ones(1 << 26)
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert int(told.stdout) < held.nbytes


def test_a_process_that_fails_says_why(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"process with none\.zip, 1 pages.*BundleError"):
        measured(tmp_path / "none.zip", 1, 1)


def test_frames_of_another_device_are_refused(tmp_path: Path) -> None:
    profile, recording = small_profile(), tmp_path / "R.h5"
    job = RecordingJob(profile, Device(), 256, 0, False, recording, None)
    job.claim(force=False)
    job.run(1)
    asked = ["--profile", "bench", "--decoder", "fast", "--recording", str(recording)]
    with pytest.raises(RecordingError, match="684"):
        CliRunner().invoke(main, asked, catch_exceptions=False, standalone_mode=False)
