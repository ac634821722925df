"""The benchmark of calibration: what it takes up from an earlier run, and what it makes of its devices."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import pytest
from click.testing import CliRunner

from analysis.comparison import calibration
from analysis.comparison.calibration import Bench, Outcome, main, summary
from lightpage.device.profile import load_profile
from lightpage.errors import InvalidInputError


def run(*arguments: str) -> str:
    return CliRunner().invoke(main, arguments, standalone_mode=False, catch_exceptions=False).output


def test_devices_that_are_done_are_not_done_again_and_those_of_others_not_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn = list[tuple[int, int]]()

    def outcome(bench: Bench, seed: int) -> Outcome:
        drawn.append((bench.profile.page.symbol_size_px, seed))
        failure = "not found" if seed == 6 and drawn.count((2, 6)) == 1 else None
        return Outcome(seed, -0.6, angle_error_deg=None if failure else 0.001 * seed, seconds=2.0, failure=failure)

    monkeypatch.setattr(calibration.Bench, "own", outcome)
    path = tmp_path / "F.json"
    arguments = ("--symbol-size", "2", "--first-seed", "5", "--json", str(path))
    run(*arguments, "--devices", "2")
    run(*arguments, "--devices", "3")
    assert drawn == [(2, 5), (2, 6), (2, 6), (2, 7)]  # what failed is tried again
    found = json.loads(path.read_text())["summary"]
    assert (found["devices"], found["calibrated"]) == (3, 3)
    assert found["angle_error_deg_worst"] == pytest.approx(0.007)
    assert found["angle_error_deg_median"] == pytest.approx(0.006)
    with pytest.raises(InvalidInputError, match="a new name"):
        run("--first-seed", "5", "--json", str(path))
    edited = tmp_path / "bench.toml"
    edited.write_text(load_profile("bench").to_toml())
    run("--profile", str(edited), "--devices", "1", "--json", str(tmp_path / "G.json"))
    edited.write_text(edited.read_text().replace("columns = 87", "columns = 86"))
    with pytest.raises(InvalidInputError, match="a new name"):
        run("--profile", str(edited), "--devices", "1", "--json", str(tmp_path / "G.json"))
    with pytest.raises(InvalidInputError, match="its pages are its own"):
        run("--foreign", "--symbol-size", "2", "--json", str(tmp_path / "H.json"))


def test_devices_that_were_not_found_count_as_devices_alone() -> None:
    lost, found = Outcome(1, -0.3, seconds=9.0, failure="no"), Outcome(2, -0.3, angle_error_deg=0.01, seconds=1.0)
    figures = summary([lost, found])
    assert (figures["devices"], figures["calibrated"], figures["angle_error_deg_worst"]) == (2, 1, 0.01)
    assert Outcome(**asdict(lost)) == lost
