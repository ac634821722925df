"""`lightpage profile`, and commands that take the profile of what they read."""

import json
from pathlib import Path

import pytest

from lightpage.cli import main
from lightpage.cli.profile import profile
from lightpage.device.profile import load_profile
from lightpage.recording.reader import Recording
from lightpage.train.commands.calibrate import calibrate


def test_a_new_profile_is_checked_and_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mine, figures = tmp_path / "mine.toml", tmp_path / "J"
    assert main.run(profile, ["new", "--out", str(mine)]) == 0
    assert main.run(profile, ["new", "--out", str(mine)]) == 2
    assert main.run(profile, ["show", str(mine), "--json", str(figures)]) == 0
    assert json.loads(figures.read_text())["symbols"] == 87 * 56
    mine.write_text(load_profile("bench").to_toml().replace("columns_px = 1368", "columns_px = 1300"))
    capsys.readouterr()
    assert main.run(profile, ["check", str(mine)]) == 2
    assert "camera.columns_px" in capsys.readouterr().err


def test_a_contradiction_to_the_recording_is_refused(
    small_device: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    named = dict(zip(small_device[::2], small_device[1::2], strict=True))
    other = tmp_path / "other.toml"
    other.write_text(Path(named["--profile"]).read_text().replace("angle_deg = 0.0", "angle_deg = 0.5"))
    options = ["--recording", named["--recording"], "--out", str(tmp_path / "C.toml")]
    assert main.run(calibrate, [*options, "--profile", str(other)]) == 2
    assert "pipe.angle_deg = 0.0 (profile small: 0.5)" in capsys.readouterr().err
    with Recording.open(named["--recording"]) as recording:
        assert recording.header.device(None).name == "small"
