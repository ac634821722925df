"""The field of many pages is that of each alone. `test_waves` compares both forms of the waves."""

from functools import cache

import numpy as np
import pytest
import torch

from lightpage.calibration.sampling_table import sampling_table
from lightpage.device.state import Device
from lightpage.page.symbols import random_symbols
from lightpage.recording.frame_pair import FramePair
from lightpage.simulator.simulator import Simulator
from lightpage.simulator.true_optics import true_parameters
from lightpage.train.models.batched.field import BatchedField, Seen
from lightpage.train.models.batched.frames import BatchedFrames
from lightpage.train.models.batched.products import Tables
from lightpage.train.models.field import FieldRecovery
from lightpage.train.models.twin import RayTwin, TorchTwin
from lightpage.waves.grid import field_grid
from tests.lightpage.small import small_profile

PROFILE = small_profile()


def relative(found: torch.Tensor, expected: torch.Tensor) -> float:
    return float((found.float() - expected).norm() / expected.norm())


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
