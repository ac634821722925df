"""The comparison with the oracle: what the oracle may know, and what the command prints."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path

import click
import numpy as np
import pytest
from click.testing import CliRunner
from lightning.pytorch.loggers import TensorBoardLogger

from analysis.comparison.decoders import main
from analysis.comparison.oracle import Oracle
from analysis.comparison.outcome import HEADER, WALLS, Outcome, gained_at_the_end, symbols_by_walls
from analysis.comparison.weight_store import CALIBRATION, TRAINED, WeightStore
from lightpage.calibration.calibrate import Registered
from lightpage.calibration.document import Calibration
from lightpage.calibration.parameters import NAMES
from lightpage.device.state import Device, Reference, Sensor, ideal_device
from lightpage.errors import InvalidInputError
from lightpage.page.symbols import pilot_mask
from lightpage.progress import reporting
from lightpage.recording.reader import Recording
from lightpage.simulator.recording_job import RecordingJob
from lightpage.simulator.true_optics import perfectly_calibrated, true_parameters
from tests.lightpage.small import small_profile
from tests.told import Told
from train.data.features import FeatureExtractor, PageFeatures
from train.fitting.curves import curves_of
from train.fitting.fitted import FITTED
from train.models.presets import FAST, PRESETS
from train.runs import BEGUN, check_begun

PROFILE = small_profile()


def calibration_of(device: Device) -> Calibration:
    """A calibration that is right: the small page has too few patches to find a device from nominal."""
    turn = device.homodyne.turn_rad
    perfect = Registered(true_parameters(PROFILE, device), np.ones(len(NAMES)), turn, 0.0, 0.5, 1.0, 0.5)
    return Calibration.from_registered(perfect, PROFILE, ["0" * 64])


def zones_of(device: Device) -> dict[str, np.ndarray]:
    return symbols_by_walls(PROFILE, calibration_of(device))


def test_symbols_are_told_apart_by_the_walls_that_their_light_meets() -> None:
    zones = zones_of(ideal_device())
    rows, columns = PROFILE.page_shape
    assert sum(zone.astype(int) for zone in zones.values()).tolist() == np.ones((rows, columns)).tolist()
    # a symbol's light leaves x f/L n off the axis, and meets a wall where that is over half of the width
    reach = PROFILE.pipe.width_m / 2 * PROFILE.lens.focal_length_m * PROFILE.pipe.refractive_index
    reach /= PROFILE.pipe.length_m * PROFILE.symbol_pitch_m
    across, down = (np.abs(np.arange(count) - (count - 1) / 2) > reach for count in (columns, rows))
    assert (zones["no wall"] == ~across & ~down[:, None]).mean() > 0.98
    assert (zones["x"] == across & ~down[:, None]).mean() > 0.98
    assert (zones["y"] == ~across & down[:, None]).mean() > 0.98


def test_the_oracle_is_spared_the_signals_own_power(tmp_path: Path) -> None:
    # a weak reference and a deep well: what is left over linear equations is |E|^2
    device = Device(reference=Reference(amplitude_ratio=1.2), sensor=Sensor(full_well_e=1e6, bit_depth=16))
    job = RecordingJob(PROFILE, device, 256, 2, truth=True, out=tmp_path / "R.h5")
    job.claim(force=False)
    job.run(1)

    def error(page: PageFeatures) -> float:
        light = page.light.astype(np.float64)[:, 0].mean(1)
        z = (light[0] + 1j * light[1]) * np.exp(-1j * page.phases)
        return float(1 - abs(z.mean()) ** 2 / np.mean(np.abs(z) ** 2))

    with Recording.open(tmp_path / "R.h5") as recording:
        wave = FeatureExtractor(perfectly_calibrated(PROFILE, device, recording.references()), "wave")
        oracle = Oracle(recording, PROFILE, device)
        assert error(next(oracle.pages([0]))) < error(next(wave.pages(recording, [0])))


def test_the_gain_at_the_end_is_read_from_the_run(tmp_path: Path) -> None:
    logger = TensorBoardLogger(str(tmp_path), name="", version="tensorboard")
    values = ((20, 1.0), (60, 2.5), (79, 2.4), (90, 2.6), (100, 2.55))
    for step, value in values:
        logger.log_metrics({"val_air": value}, step)
    logger.finalize("done")
    curve = curves_of(tmp_path)["val_air"]
    assert curve == [(step, pytest.approx(value, abs=1e-5)) for step, value in values]
    assert gained_at_the_end(curve, 100) == pytest.approx(0.1, abs=1e-5)


def test_an_arm_that_still_learns_is_marked() -> None:
    outcome = Outcome(
        run="mode",
        method="mode",
        size="32/64",
        steps=100,
        air=3.0,
        own_mi=3.1,
        own_mi_unscaled=3.2,
        page_kB=1.5,
        own_mi_kB=1.55,
        by_walls=dict.fromkeys(WALLS, 3.0),
        validation_air=3.0,
        gained_in_last_fifth=0.019,
        preparing_seconds=60.0,
        training_seconds=60.0,
        pages_per_second=1.0,
        kappa_scale=1.0,
        training_curve=[],
        validation_curve=[],
    )
    assert outcome.is_settled
    assert len(outcome.line()) == len(HEADER)
    assert list(outcome.as_json())[:3] == ["run", "arm", "size"]  # the file's keys are a contract
    assert (outcome.as_json()["arm"], outcome.as_json()["looks"]) == ("mode", 1)
    for gained in (0.02, float("nan")):
        learning = replace(outcome, gained_in_last_fifth=gained)
        assert not learning.is_settled
        assert learning.line() == outcome.line().replace("0.019 ", f"{gained:>5.3f}*")


@pytest.mark.long
def test_the_command_compares_the_methods_and_takes_up_what_is_there(tmp_path: Path) -> None:
    profile = tmp_path / "small.toml"
    profile.write_text(PROFILE.to_toml())
    out = tmp_path / "out"
    data_set = out / "-0.6deg-32e-4px"
    data_set.mkdir(parents=True)
    calibration_of(Device()).save(data_set / "calibration.toml")
    arguments = f"--profile {profile} --pages 12 --steps 20 --size 8x1x0"
    arguments += "".join(
        f" --method {name}" for name in ("coherent", "refined", "oracle", "fast", "none", "oracle-refined")
    )
    arguments += " --arm wave-refined"  # the option's earlier name
    arguments += f" --published-channels 4 --published-steps 12 --levels 16 --trained {tmp_path / 'kept'} --keep"
    arguments += f" --out {out}"
    first = CliRunner().invoke(main, arguments.split(), catch_exceptions=False)
    assert first.exit_code == 0, first.output
    assert "-0.6 degree, full well 32 e-, exposure 1, symbols of 4x4 pixels" in first.output
    (figures,) = json.loads((out / "figures.json").read_text())["lights"]
    coherent, refined, oracle, fast, none, again, by_waves = figures["outcomes"]
    assert (refined["arm"], refined["steps"]) == ("refined 1", 5)
    by_levels = [[figures["levels"] for figures in method["by_levels"]] for method in figures["outcomes"]]
    assert by_levels == [[16], [16], [16], [16], [], [16], [16]]
    assert all(0 < method["by_levels"][0]["symbol_error_rate"] <= 0.8 for method in (coherent, refined, oracle))
    assert all(len(method["validation_curve"]) > 0 for method in figures["outcomes"])
    # who is made less sure claims less than before, and who is made surer more
    for method in figures["outcomes"]:
        assert np.sign(method["own_mi_unscaled"] - method["own_mi"]) == np.sign(1 - method["kappa_scale"]) != 0
    # the mean over all symbols is that of the zones, weighted by their symbols
    data = ~pilot_mask(PROFILE)
    shares = {name: (zone & data).sum() / data.sum() for name, zone in zones_of(Device()).items()}
    for method in figures["outcomes"]:
        assert method["air"] == pytest.approx(sum(share * method["by_walls"][name] for name, share in shares.items()))
    assert "no wall" in first.output
    assert len(coherent["training_curve"]) > 0
    for method in figures["outcomes"]:
        assert method["own_mi_kB"] == pytest.approx(method["own_mi"] * data.sum() / 8000)
    assert (out / "figure.png").stat().st_size > 10_000
    assert (coherent["arm"], oracle["arm"], oracle["over_oracle"]) == ("coherent", "oracle", 1)
    assert coherent["over_oracle"] == pytest.approx(coherent["air"] / oracle["air"])
    assert (fast["arm"], fast["size"], fast["steps"]) == ("fast", "48x2x0", 20)
    assert (none["arm"], none["size"], none["steps"]) == ("none", "4/8", 12)
    assert none["over_oracle"] == pytest.approx(none["air"] / oracle["air"])
    assert coherent["over_published"] == pytest.approx(coherent["air"] / none["air"])
    assert none["over_published"] is None
    # who makes two passes is compared with an oracle that does
    assert (again["arm"], again["looks"], again["steps"], again["over_oracle"]) == ("oracle-refined 1", 2, 5, 1)
    assert refined["over_oracle"] == pytest.approx(refined["air"] / again["air"])
    assert (by_waves["arm"], by_waves["looks"], by_waves["run"]) == (
        "wave-refined 1",
        2,
        f"{data_set.name}/wave/8x1x0-20/refinement-1",
    )
    assert first.output.count("of theirs") == len(figures["outcomes"]) + 1  # whenever a method is there, and in the end
    assert figures["angle_error_deg"] == pytest.approx(0, abs=1e-9)
    told = Told()
    with reporting(told):
        again = CliRunner().invoke(main, arguments.split(), catch_exceptions=False)
    assert {what for what, unit in told.loops if unit == "page"} == {"light of known pages"}
    outcomes = json.loads((out / "figures.json").read_text())["lights"][0]["outcomes"]
    for one, other in zip(outcomes, figures["outcomes"], strict=True):
        assert one == other
    # elsewhere, what was kept is measured and not trained
    elsewhere = tmp_path / "elsewhere"
    arguments = arguments.replace(f"--out {out}", f"--out {elsewhere}")
    measured = CliRunner().invoke(main, arguments.split(), catch_exceptions=False)
    assert measured.output.count("trained before: ") == 5  # refined goes on from coherent
    assert not list(elsewhere.rglob("checkpoints"))
    outcomes = json.loads((elsewhere / "figures.json").read_text())["lights"][0]["outcomes"]
    for one, other in zip(outcomes, figures["outcomes"], strict=True):
        assert one["air"] == pytest.approx(other["air"], abs=0.01)  # large tensors are kept in half precision
        assert one["validation_curve"] == other["validation_curve"]
    kept = WeightStore(data_set, tmp_path / "kept" / "small" / data_set.name, adds=True)
    assert "commit" in json.loads((kept.folder / "oracle" / "8x1x0-20" / FITTED).read_text())["made_by"]
    assert kept.is_of_this_data_set
    # only trainings of this data set, this calibration and these options are taken up
    run = data_set / "oracle" / "8x1x0-20"
    options = json.loads((run / "begun.json").read_text())
    options.pop("format")
    new = replace(kept, data_set=elsewhere / "new")
    new.data_set.mkdir()
    shutil.copyfile(data_set / "begun.json", new.data_set / "begun.json")
    new.bring_calibration()
    assert not new.bring(new.data_set / run.relative_to(data_set), options | {"steps": 30})
    (new.data_set / "calibration.toml").write_text("another")
    assert not new.bring(new.data_set / run.relative_to(data_set), options)
    shutil.copyfile(data_set / "calibration.toml", new.data_set / "calibration.toml")
    assert new.bring(new.data_set / run.relative_to(data_set), options)
    assert not new.bring(new.data_set / run.relative_to(data_set), options)  # it is there
    # and nothing of another data set is mixed with them
    (new.data_set / "begun.json").write_text("{}")
    shutil.rmtree(new.data_set / run.relative_to(data_set))
    assert not new.bring(new.data_set / run.relative_to(data_set), options)
    with pytest.raises(InvalidInputError, match="another data set"):
        new.bring_calibration()
    with pytest.raises(InvalidInputError, match="another one"):
        new.keep(new.data_set / run.relative_to(data_set))
    with pytest.raises(click.BadParameter, match="96x2x0"):
        CliRunner().invoke(main, ["--size", "96", "--out", str(out)], standalone_mode=False, catch_exceptions=False)


def test_what_was_kept_under_earlier_names_is_taken_up(tmp_path: Path) -> None:
    kept = TRAINED / "bench" / "-0.6deg-32e-4px"
    for name in (BEGUN, CALIBRATION):
        shutil.copyfile(kept / name, tmp_path / name)
    run = tmp_path / "fast" / "48x2x0-6000"
    options = asdict(replace(PRESETS[FAST].choices, steps=6000, seed=5000))
    assert "levels" in json.loads((kept / run.relative_to(tmp_path) / BEGUN).read_text())
    assert not WeightStore(tmp_path, kept).bring(run, options | {"depth": 1})
    assert WeightStore(tmp_path, kept).bring(run, options)
    assert check_begun(run, options)


def test_an_ideal_device_has_the_angle_and_the_noise_alone(tmp_path: Path) -> None:
    profile = tmp_path / "small.toml"
    profile.write_text(PROFILE.to_toml())
    data_set = tmp_path / "out" / "-0.3deg-32e-4px-ideal"
    data_set.mkdir(parents=True)
    ideal = ideal_device().with_settings(["geometry.pipe_angle_deg=-0.3", "sensor.full_well_e=32"])
    calibration_of(ideal).save(data_set / "calibration.toml")
    arguments = f"--profile {profile} --ideal --angle -0.3 --pages 12 --method none --published-channels 4"
    arguments += f" --published-steps 10 --trained {tmp_path / 'kept'} --out {tmp_path / 'out'}"
    ran = CliRunner().invoke(main, arguments.split(), catch_exceptions=False)
    assert ran.exit_code == 0, ran.output
    assert "symbols of 4x4 pixels, ideal device" in ran.output
    assert Device.model_validate(json.loads((data_set / "begun.json").read_text())["device"]) == ideal


def test_what_is_wrong_is_told_in_a_line(tmp_path: Path) -> None:
    command = [
        sys.executable,
        "-m",
        "analysis.comparison.decoders",
        "--profile",
        "nosuch",
        "--out",
        str(tmp_path / "out"),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=Path(__file__).parents[3])
    assert done.returncode == 2
    assert re.fullmatch(r"lightpage: error: profile nosuch: .*bench, paper\n", done.stderr)
