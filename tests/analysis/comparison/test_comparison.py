"""Comparisons of decoders: what each command writes, and what it takes up from earlier runs."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from analysis.comparison import decoders, imperfections, kept_figures
from analysis.comparison.kept_figures import FOURTH_DIGIT
from analysis.comparison.kept_weights import moved_bits
from analysis.comparison.outcome import symbols_by_walls
from lightpage.calibration.calibrate import Registered
from lightpage.calibration.document import Calibration
from lightpage.calibration.parameters import NAMES
from lightpage.device.state import Device, ideal_device
from lightpage.page.symbols import pilot_mask
from lightpage.run_files import BEGUN
from lightpage.simulator.true_optics import true_parameters
from lightpage.train.fitting.fitted import FITTED_WEIGHTS
from lightpage.train.published.training import PublishedChoices
from lightpage.train.runs import FORMAT
from tests.lightpage.small import small_profile

PROFILE = small_profile()


def calibration_of(device: Device) -> Calibration:
    """A calibration that is right: the small page has too few patches to find a device from nominal."""
    turn = device.homodyne.turn_rad
    perfect = Registered(true_parameters(PROFILE, device), np.ones(len(NAMES)), turn, 0.0, 0.5, 1.0, 0.5)
    return Calibration.from_registered(perfect, PROFILE, ["0" * 64])


def test_symbols_are_told_apart_by_the_walls_that_their_light_meets() -> None:
    zones = symbols_by_walls(PROFILE, calibration_of(ideal_device()))
    rows, columns = PROFILE.page_shape
    # a symbol's light leaves x f/L n off the axis, and meets a wall where that is over half of the width
    reach = PROFILE.pipe.width_m / 2 * PROFILE.lens.focal_length_m * PROFILE.pipe.refractive_index
    reach /= PROFILE.pipe.length_m * PROFILE.symbol_pitch_m
    across, down = (np.abs(np.arange(count) - (count - 1) / 2) > reach for count in (columns, rows))
    assert (zones["no wall"] == ~across & ~down[:, None]).mean() > 0.98
    assert (zones["x"] == across & ~down[:, None]).mean() > 0.98
    assert sum(zone.astype(int) for zone in zones.values()).tolist() == np.ones((rows, columns)).tolist()


def test_the_command_compares_methods_and_says_what_the_device_is(tmp_path: Path) -> None:
    (folder := tmp_path / "-0.3deg-32e-4px-ideal").mkdir()
    calibration_of(ideal_device()).save(folder / "calibration.toml")
    (tmp_path / "small.toml").write_text(PROFILE.to_toml())
    words = ["--profile", str(tmp_path / "small.toml"), "--pages", "12", "--out", str(tmp_path)]
    words += ["--ideal", "--angle", "-0.3", "--method", "none", "--published-channels", "4", "--published-steps", "10"]
    words += ["--trained", str(tmp_path / "kept"), "--keep"]
    done = CliRunner().invoke(decoders.main, words, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    begun = json.loads((folder / BEGUN).read_text())
    ideal = ideal_device().with_settings(["geometry.pipe_angle_deg=-0.3", "sensor.full_well_e=32"])
    assert Device.model_validate(begun["device"]) == ideal
    (found,) = json.loads((tmp_path / "figures.json").read_text())["data_sets"]
    (none,) = found["outcomes"]
    assert (none["method"], none["size"], none["steps"]) == ("none", "4/8", 10)
    assert len(none["validation_curve"]) > 0
    data = ~pilot_mask(PROFILE)
    assert none["own_mi_kB"] == pytest.approx(none["own_mi"] * data.sum() / 8000)
    assert (tmp_path / "figure.png").stat().st_size > 10_000
    shutil.move(folder / "none", tmp_path / "trained" / "none")
    done = CliRunner().invoke(decoders.main, words, catch_exceptions=False)
    assert "trained before" in done.output
    (found,) = json.loads((tmp_path / "figures.json").read_text())["data_sets"]
    assert found["outcomes"][0]["air"] == pytest.approx(none["air"], abs=FOURTH_DIGIT)
    both = ["--kept", str(tmp_path / "kept" / "small" / folder.name), "--trained", str(tmp_path / "trained")]
    words = [*both, "--pages", "1", "--out", str(tmp_path / "figures")]
    done = CliRunner().invoke(kept_figures.main, words, catch_exceptions=False)
    (line,) = (line.split() for line in done.output.splitlines() if line.startswith("none"))
    assert float(line[1]) == pytest.approx(float(line[2]), abs=FOURTH_DIGIT)
    trained, kept = sorted((tmp_path / "figures").rglob(FITTED_WEIGHTS))
    assert trained.read_bytes() != kept.read_bytes()


def test_kept_published_weights_are_those_of_the_authors_choices() -> None:
    kept = Path("analysis/weights/bench/-0.6deg-32e-4px/ray/32-64-11250", BEGUN).read_text()
    assert json.loads(kept) == {"format": FORMAT, **PublishedChoices(seed=5000).kept()}


def test_what_is_said_moves_by_the_relative_entropy() -> None:
    said = np.array([4.0, -3.0]).reshape(1, 2, 1, 1)
    theta = np.linspace(-np.pi, np.pi, 4000, endpoint=False)

    def log_density(p: np.ndarray) -> np.ndarray:
        log = p[0, 0] * np.cos(theta) + p[0, 1] * np.sin(theta)
        return np.asarray((log - np.log(np.exp(log).sum()))[0])

    now = np.array([1.0, 2.0]).reshape(1, 2, 1, 1)
    before, after = log_density(said), log_density(now)
    assert moved_bits(said, now) == pytest.approx(np.sum(np.exp(before) * (before - after)) / np.log(2), rel=1e-6)
    assert moved_bits(said, said) == 0


def test_a_decoder_of_a_device_of_ones_own_is_told_beside_an_oracle(tmp_path: Path) -> None:
    settings = ["in_phase_camera.axial_rad=0.4", "quadrature_camera.axial_rad=-0.3"]
    device = Device().of_profile(PROFILE).with_settings(settings)
    (tmp_path / "set").mkdir()
    calibration_of(device).save(tmp_path / "set" / "calibration.toml")
    (tmp_path / "small.toml").write_text(PROFILE.to_toml())
    words = ["--profile", str(tmp_path / "small.toml"), "--pages", "6", "--steps", "10", "--out", str(tmp_path)]
    words += [word for setting in settings for word in ("--set", setting)]
    done = CliRunner().invoke(imperfections.main, words, catch_exceptions=False)
    (row,) = json.loads((tmp_path / "imperfections.json").read_text())["rows"]
    assert done.output.splitlines()[-1].split()[:3] == ["set", f"{row['air']:.3f}", f"{row['oracle_air']:.3f}"]
    assert row["air"] == pytest.approx(row["oracle_air"], rel=0.1)
    assert row["air"] > 3
