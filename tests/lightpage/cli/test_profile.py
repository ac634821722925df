"""`lightpage profile`: a file to fill in, what follows from it, and what is refused."""

import json
from pathlib import Path

import pytest

from lightpage.cli import main
from lightpage.cli.profile import profile
from lightpage.device.profile import load_profile


def test_a_new_profile_is_checked_and_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mine, figures = tmp_path / "mine.toml", tmp_path / "J"
    assert main.run(profile, ["new", "--out", str(mine)]) == 0
    assert main.run(profile, ["new", "--out", str(mine)]) == 2
    assert main.run(profile, ["show", str(mine), "--json", str(figures)]) == 0
    assert json.loads(figures.read_text())["symbols"] == 87 * 56
    assert main.run(profile, ["keys", "--json", str(figures)]) == 0
    assert {"table": "pipe", "name": "width_m"}.items() <= json.loads(figures.read_text())["keys"][6].items()
    mine.write_text(load_profile("bench").to_toml().replace("columns_px = 1368", "columns_px = 1300"))
    capsys.readouterr()
    assert main.run(profile, ["check", str(mine)]) == 2
    assert "camera.columns_px" in capsys.readouterr().err
