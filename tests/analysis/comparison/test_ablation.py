"""Leaving out parts of one coherent pass: what is left out is left out, and what the command prints."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from analysis.comparison.ablation import (
    LOW_PASS,
    NOTHING,
    POSITIONS,
    REFLECTIONS,
    Unconditioned,
    features_without,
    main,
)
from analysis.comparison.bench import Bench
from analysis.comparison.data_set import data_set_name, recorded
from analysis.comparison.weight_store import WeightStore
from lightpage.device.state import Device, Sensor
from lightpage.progress import reporting
from tests.analysis.comparison.test_decoders import PROFILE, calibration_of
from tests.told import Told

DEVICE = Device().with_settings(["geometry.pipe_angle_deg=-0.6", "sensor.full_well_e=32"])


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the calibration of the small device, which is too small to be found from nominal."""
    out = tmp_path_factory.mktemp("ablation")
    data_set = out / data_set_name(DEVICE, PROFILE.page.symbol_size_px)
    data_set.mkdir()
    calibration_of(DEVICE).save(data_set / "calibration.toml")
    return out


@pytest.fixture(scope="module")
def bench(out: Path) -> Iterator[Bench]:
    folder = out / data_set_name(DEVICE, PROFILE.page.symbol_size_px)
    with recorded(PROFILE, DEVICE, 12, 5000, folder) as recording:
        yield Bench.of(recording, PROFILE, DEVICE, (), 5000, WeightStore(folder, folder / "kept"))


def test_data_sets_are_told_apart_by_name() -> None:
    assert data_set_name(DEVICE, 4) == "-0.6deg-32e-4px"
    dim = DEVICE.model_copy(update={"sensor": Sensor(full_well_e=32, exposure_relative=0.13)})
    assert data_set_name(dim, 2, "-ideal") == "-0.6deg-32e-2px-0.13x-ideal"


def test_parts_of_the_light_are_left_out(bench: Bench) -> None:
    whole, direct, unfiltered = (
        next(features_without(part, bench, 0, (0.0, 0.0))).light for part in (NOTHING, REFLECTIONS, LOW_PASS)
    )
    assert np.all(direct[:, 1:] == 0)
    np.testing.assert_array_equal(direct[:, 0], whole[:, 0])
    assert np.abs(whole[:, 1:]).max() > 0
    assert unfiltered.shape == whole.shape
    assert not np.array_equal(unfiltered, whole)


def test_without_positions_a_network_stays_the_same_everywhere() -> None:
    torch.manual_seed(0)
    network = Unconditioned(8, channels=4, blocks=1)
    torch.nn.init.normal_(network.head.weight)
    light = torch.randn(1, 8, 5, 6)
    optimizer = torch.optim.AdamW(network.parameters(), lr=0.1)
    for _ in range(2):
        network(light, torch.randn(1, 2, 5, 6)).square().sum().backward()
        optimizer.step()
    assert network.stem.weight.grad is not None
    here, there = (network(light, torch.full((1, 2, 5, 6), place)) for place in (0.1, 1.7))
    torch.testing.assert_close(here, there, rtol=0, atol=0)


def test_the_command_prints_the_parts_and_takes_up_what_is_there(out: Path, tmp_path: Path, bench: Bench) -> None:
    profile = tmp_path / "small.toml"
    profile.write_text(PROFILE.to_toml())
    arguments = f"--profile {profile} --pages 12 --steps 10 --part {NOTHING} --part {POSITIONS} --out {out}".split()
    told = Told()
    with reporting(told):
        first = CliRunner().invoke(main, arguments, catch_exceptions=False)
    assert first.exit_code == 0, first.output
    assert "filters that depend on where a symbol lies" in first.output
    outcomes = json.loads((out / "ablation.json").read_text())["outcomes"]
    assert [outcome["arm"] for outcome in outcomes] == [NOTHING, POSITIONS]
    assert ("features without nothing", "page") in told.loops
    told = Told()
    with reporting(told):
        CliRunner().invoke(main, arguments, catch_exceptions=False)
    assert not any(what.startswith("features without") for what, _ in told.loops)
    assert json.loads((out / "ablation.json").read_text())["outcomes"] == outcomes
