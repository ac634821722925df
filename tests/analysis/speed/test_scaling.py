"""Time per symbol as pages grow: the table names every page and compares it with the smallest."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from analysis.speed.scaling import main
from tests.lightpage.small import small_profile


@pytest.mark.long
def test_pages_grow_by_the_square_of_the_factor(tmp_path: Path) -> None:
    profile, figures = tmp_path / "small.toml", tmp_path / "F.json"
    profile.write_text(small_profile().to_toml())
    asked = ["--profile", str(profile), "--factor", "1", "--factor", "2", "--repeats", "1", "--json", str(figures)]
    output = CliRunner().invoke(main, asked, catch_exceptions=False, standalone_mode=False).output
    one, two = json.loads(figures.read_text())["pages"]
    assert (one["symbols"], two["symbols"]) == (44 * 28, 4 * 44 * 28)
    over = (two["seconds"] / two["symbols"]) / (one["seconds"] / one["symbols"])
    assert float(output.splitlines()[-1].split()[-1]) == pytest.approx(over, abs=1e-3)
