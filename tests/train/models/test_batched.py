"""The decoder for many pages says what that for one page says, part by part."""

from functools import cache

import numpy as np
import pytest
import torch

from lightpage.calibration.parameters import NAMES, PRIORS
from lightpage.calibration.sampling_table import sampling_table
from lightpage.calibration.waves.wave_model import FittedWaves
from lightpage.device.state import Device
from lightpage.page.symbols import random_symbols
from lightpage.recording.frame_pair import FramePair
from lightpage.simulator.simulator import Simulator
from lightpage.simulator.true_optics import true_parameters
from lightpage.train.models.batched.decoder import WaysBack
from lightpage.train.models.batched.field import BatchedField, Seen
from lightpage.train.models.batched.frames import BatchedFrames
from lightpage.train.models.batched.products import Tables
from lightpage.train.models.batched.waves import BatchedWaves
from lightpage.train.models.field import FieldRecovery
from lightpage.train.models.parts import stacked
from lightpage.train.models.twin import RayTwin, TorchTwin
from lightpage.train.models.waves import EXACT, Waves
from lightpage.waves.grid import field_grid
from tests.lightpage.small import THICK, small_profile

PROFILE = small_profile()


def relative(found: torch.Tensor, expected: torch.Tensor) -> float:
    return float((found.float() - expected).norm() / expected.norm())


def knocked() -> np.ndarray:
    """Parameters none of which is zero: the pipe sheared and rolled, planes off their place and tilted, all phases."""
    parameters = true_parameters(PROFILE, Device())
    drawn = 0.5 * PRIORS * np.random.default_rng(3).standard_normal(len(NAMES))
    parameters = np.where(parameters == 0, drawn, parameters)
    parameters[NAMES.index("pipe_angle_rad")] = -0.01
    assert np.all(parameters)
    return parameters


@pytest.mark.parametrize("shear", [1.0, 0.0], ids=["sheared", "square"])
def test_waves_go_both_ways_as_those_of_one_page(shear: float) -> None:
    profile, parameters = PROFILE.model_copy(update={"lens_path": THICK}), knocked()
    parameters[NAMES.index("pipe_angle_rad")] *= shear
    usual, fitted = Waves(profile, parameters, 4, EXACT), FittedWaves(profile, parameters, 4)
    light = np.exp(2j * np.pi * np.random.default_rng(0).random(fitted.launch.shape)).astype(np.complex64)
    page, field = stacked(light), stacked(fitted.to_camera(light))
    back, there = WaysBack(usual), BatchedWaves(usual, to_page=False)
    down, across = (torch.from_numpy(each).float() for each in usual.interpolations)
    with torch.no_grad():
        tables = _typed(back.tables(usual.default), torch.float32)
        missing = 0, -field.shape[-1] % 8, 0, -field.shape[-2] % 8
        two = torch.nn.functional.pad(torch.stack([field, 0.5 * field]), missing)
        found = back.waves.last.cropped(back.waves(back.sparse((two[:, 0], two[:, 1]), tables), tables))
        expected = usual.to_page(usual.matrices(), field)
        spread_y, spread_x = (
            there.first.laid_out(torch.eye(count), axis) for axis, count in zip("yx", page.shape[1:], strict=True)
        )
        tables = _typed(there.tables(usual.default), torch.float32)
        sparse = there.last.cropped(there((spread_y.T @ page @ spread_x)[None], tables))[0]
    for number, factor in enumerate((1, 2)):
        assert relative(factor * found[number], expected) < 0.006
    assert relative(found[0], stacked(fitted.to_page(fitted.to_camera(light)))) < 0.02
    seen = down @ sparse @ across.T
    assert relative(seen, usual.to_camera(usual.matrices(), page)) < 0.006
    assert relative(seen, field) < 0.02


@cache
def shown() -> tuple[FramePair, FramePair, dict[str, torch.Tensor]]:
    """A page, the references and the device's table."""
    device = Device()
    simulator = Simulator(PROFILE, device, seed=3)  # with 2 rounding takes the other of two roots somewhere
    page = simulator.page(random_symbols(PROFILE, 256, 1, np.random.default_rng(1))[0])
    parameters = true_parameters(PROFILE, device)
    table = sampling_table(TorchTwin(RayTwin(PROFILE)), parameters, device.homodyne.turn_rad, PROFILE)
    return page, simulator.references(), {name: torch.from_numpy(table[name]) for name in ("registration", "homodyne")}


@pytest.mark.parametrize(
    "recovery",
    [
        FieldRecovery(PROFILE, reflections=4),
        FieldRecovery(PROFILE),
        FieldRecovery(PROFILE, rounds=0, binning=2, grid=field_grid(PROFILE, 3)),
    ],
    ids=["reflections", "descent", "closed root"],
)
@pytest.mark.parametrize(
    ("dtype", "bits", "error"),
    [(torch.float32, 8, 1e-4), (torch.float16, 8, 3e-3), (torch.float16, 16, 3e-3)],
    ids=["float32", "float16", "float16 of 16 bits"],
)
def test_the_field_is_that_of_one_page(recovery: FieldRecovery, dtype: torch.dtype, bits: int, error: float) -> None:
    pair, empty, table = shown()
    page, references = (
        [torch.from_numpy((bits - 7) * frame.astype(f"uint{bits}")) for frame in (each.in_phase, each.quadrature)]
        for each in (pair, empty)
    )
    with torch.no_grad():
        expected, left = recovery(*page, *references, table["registration"], table["homodyne"])
        blocks = recovery.in_blocks(*references)
        seen = recovery.references(blocks, table["registration"])
        frames, field = BatchedFrames(recovery, bits, dtype), BatchedField(recovery)
        tables = _typed({**frames.tables(blocks, seen), **field.tables(seen, table["homodyne"])}, dtype)
        still, cameras = torch.zeros(2, 2), enumerate(page)
        both = Seen(*(frames(torch.stack([each, each]), still, tables, camera) for camera, each in cameras))
        found = field(both, tables)
        residual = field.residual(both, found, field.power(found), tables)
    ny, nx = recovery.grid.shape
    for number in (0, 1):
        assert relative(torch.stack([part[number, :ny, :nx] for part in found]), expected) < error
    np.testing.assert_allclose(residual.numpy(), float(left.square().mean() / expected.square().mean()), rtol=0.08)


def _typed(tables: Tables, dtype: torch.dtype) -> Tables:
    return {name: value.float() if "where" in name else value.to(dtype) for name, value in tables.items()}
