"""The table of both forms of the wave operators is measured of the same light."""

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from analysis.gpu.wave_forms import main
from tests.lightpage.small import small_profile


def test_both_forms_are_timed_and_agree(tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(small_profile().to_toml())
    asked = "--profile", tmp_path / "small.toml", "--repeats", 1, "--threads", 1, "--json", tmp_path / "F.json"
    CliRunner().invoke(main, [*map(str, asked)], catch_exceptions=False, standalone_mode=False)
    tiles, planes = json.loads((tmp_path / "F.json").read_text())["forms"]
    assert (tiles["forward_ratio"], tiles["adjoint_ratio"], tiles["deviation"]) == (1, 1, 0)
    assert 0 < planes["deviation"] < 0.01
    assert planes["forward_ms"] == pytest.approx(planes["forward_ratio"] * tiles["forward_ms"])
