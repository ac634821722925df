"""The comparison with the oracle: what the oracle may know, and what the command prints."""

from __future__ import annotations

import json
from pathlib import Path

import click
import numpy as np
import pytest
from click.testing import CliRunner
from lightning.pytorch.loggers import TensorBoardLogger

from benchmarks.decoders import arms, gained_at_the_end, main
from optics.device import Device, Reference, Sensor
from optics.page import random_symbols
from optics.registration.calibrate import Registered
from optics.registration.calibration import Calibration
from optics.registration.parameters import NAMES
from optics.simulator import Simulator, true_parameters
from tests.optics.small import small_profile

PROFILE = small_profile()


def calibration_of(device: Device) -> Calibration:
    """A calibration that is right: the small page has too few patches to find a device from nominal."""
    turn = device.homodyne.turn_rad
    perfect = Registered(true_parameters(PROFILE, device), np.ones(len(NAMES)), turn, 0.0, 0.5, 1.0, 0.5)
    return Calibration.from_registered(perfect, PROFILE, ["0" * 64])


def test_the_oracle_is_spared_the_signals_own_power() -> None:
    # a weak reference and a deep well: what is left over linear equations is |E|^2
    device = Device(reference=Reference(amplitude_ratio=1.2), sensor=Sensor(full_well_e=1e6, bit_depth=16))
    simulator = Simulator(PROFILE, device, seed=2)
    fitted = calibration_of(device)
    pages = list(random_symbols(PROFILE, 256, 1, np.random.default_rng(2)))

    def error(arm: object) -> float:
        page = next(arm.features(Simulator(PROFILE, device, seed=2), pages, 0, (0.0, 0.0)))  # type: ignore[attr-defined]
        light = page.light.astype(np.float64)[:, 0].mean(1)
        z = (light[0] + 1j * light[1]) * np.exp(-1j * page.phases)
        return float(1 - abs(z.mean()) ** 2 / np.mean(np.abs(z) ** 2))

    wave, oracle = arms(PROFILE, device, fitted, simulator.references(), ("wave", "oracle"))
    assert error(oracle) < error(wave)


def test_the_gain_at_the_end_is_read_from_the_run(tmp_path: Path) -> None:
    logger = TensorBoardLogger(str(tmp_path), name="", version="tensorboard")
    for step, value in ((20, 1.0), (60, 2.5), (79, 2.4), (90, 2.6), (100, 2.55)):
        logger.log_metrics({"val_air": value}, step)
    logger.finalize("done")
    assert gained_at_the_end(tmp_path, 100) == pytest.approx(0.1, abs=1e-5)


def test_the_command_compares_the_arms_and_takes_up_what_is_there(tmp_path: Path) -> None:
    profile = tmp_path / "small.toml"
    profile.write_text(PROFILE.to_toml())
    out = tmp_path / "out"
    out.mkdir()
    calibration_of(Device()).save(out / "calibration.toml")
    arguments = f"--profile {profile} --pages 12 --steps 20 --size 8x1x0 --arm coherent --arm oracle --out {out}"
    first = CliRunner().invoke(main, arguments.split(), catch_exceptions=False)
    assert first.exit_code == 0, first.output
    figures = json.loads((out / "figures.json").read_text())
    coherent, oracle = figures["outcomes"]
    assert (coherent["arm"], oracle["arm"], oracle["over_oracle"]) == ("coherent", "oracle", 1)
    assert coherent["over_oracle"] == pytest.approx(coherent["air"] / oracle["air"])
    assert figures["angle_error_deg"] == pytest.approx(0, abs=1e-9)
    again = CliRunner().invoke(main, arguments.split(), catch_exceptions=False)
    assert "page/s" not in again.output
    for one, other in zip(json.loads((out / "figures.json").read_text())["outcomes"], figures["outcomes"], strict=True):
        # training is timed up to the last checkpoint, some moments before its end
        assert one.pop("training_seconds") == pytest.approx(other.pop("training_seconds"), rel=0.2)
        assert one == other
    with pytest.raises(click.BadParameter, match="96x2x0"):
        CliRunner().invoke(main, ["--size", "96", "--out", str(out)], standalone_mode=False, catch_exceptions=False)
