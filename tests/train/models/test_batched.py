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


class TestWaves:
    """Both ways, of a device that deviates in all that a calibration fits."""

    @pytest.fixture(params=[knocked, lambda: true_parameters(PROFILE, Device()) * 0], ids=["sheared", "square"])
    def waves(self, request: pytest.FixtureRequest) -> tuple[Waves, FittedWaves]:
        """The form for one page, and the simulation."""
        parameters = request.param()
        profile = PROFILE.model_copy(update={"lens_path": THICK})
        return Waves(profile, parameters, 4, EXACT), FittedWaves(profile, parameters, 4)

    def test_fields_come_back_to_the_page(self, waves: tuple[Waves, FittedWaves]) -> None:
        usual, fitted = waves
        rng = np.random.default_rng(0)
        page = np.exp(2j * np.pi * rng.random(fitted.launch.shape)).astype(np.complex64)
        field = stacked(fitted.to_camera(page))
        back = WaysBack(usual)
        with torch.no_grad():
            tables = {name: value.float() for name, value in back.tables(usual.default).items()}
            two = torch.nn.functional.pad(torch.stack([field, 0.5 * field]), _missing(field))
            found = back.waves(back.sparse((two[:, 0], two[:, 1]), tables), tables)
            cropped = back.waves.last.cropped(found)
            expected = usual.to_page(usual.matrices(), field)
        assert relative(cropped[0], expected) < 0.006
        assert relative(2 * cropped[1], expected) < 0.006
        assert relative(cropped[0], stacked(fitted.to_page(fitted.to_camera(page)))) < 0.02

    def test_pages_light_the_cameras(self, waves: tuple[Waves, FittedWaves]) -> None:
        usual, fitted = waves
        rng = np.random.default_rng(1)
        page = stacked(np.exp(2j * np.pi * rng.random(fitted.launch.shape)).astype(np.complex64))
        there = BatchedWaves(usual, to_page=False)
        down, across = (torch.from_numpy(each).float() for each in usual.interpolations)
        with torch.no_grad():
            tables = {name: value.float() for name, value in there.tables(usual.default).items()}
            sides = zip("yx", page.shape[1:], strict=True)
            spread_y, spread_x = (there.first.laid_out(torch.eye(count), axis) for axis, count in sides)
            sparse = there.last.cropped(there((spread_y.T @ page @ spread_x)[None], tables))[0]
            expected = usual.to_camera(usual.matrices(), page)
        assert relative(down @ sparse @ across.T, expected) < 0.006


def _missing(field: torch.Tensor) -> tuple[int, ...]:
    return (0, -field.shape[-1] % 8, 0, -field.shape[-2] % 8)


class TestField:
    """From frames to the field, by each way that a decoder may recover it."""

    @staticmethod
    @cache
    def shown() -> tuple[FramePair, FramePair, dict[str, torch.Tensor]]:
        """A page, the references and the device's table."""
        device = Device()
        simulator = Simulator(PROFILE, device, seed=2)
        page = simulator.page(random_symbols(PROFILE, 256, 1, np.random.default_rng(1))[0])
        parameters = true_parameters(PROFILE, device)
        table = sampling_table(TorchTwin(RayTwin(PROFILE)), parameters, device.homodyne.turn_rad, PROFILE)
        chosen = {name: torch.from_numpy(table[name]) for name in ("registration", "homodyne")}
        return page, simulator.references(), chosen

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
    def test_the_field_is_that_of_one_page(
        self,
        recovery: FieldRecovery,
        dtype: torch.dtype,
        bits: int,
        error: float,
    ) -> None:
        shown, counts = self.shown(), 1 if bits == 8 else 16
        page, references = (
            [torch.from_numpy(counts * frame.astype(f"uint{bits}")) for frame in (pair.in_phase, pair.quadrature)]
            for pair in shown[:2]
        )
        table = shown[2]
        with torch.no_grad():
            measured = recovery.measure(*page, *references, table["registration"], table["homodyne"])
            expected, left = recovery.solve(measured)
            blocks = recovery.in_blocks(*references)
            seen = recovery.references(blocks, table["registration"])
            frames, field = BatchedFrames(recovery, bits, dtype), BatchedField(recovery)
            tables = _typed({**frames.tables(blocks, seen), **field.tables(seen, table["homodyne"])}, dtype)
            both = Seen(*(frames(torch.stack([each, each]), tables, camera) for camera, each in enumerate(page)))
            found = field(both, tables)
            residual = field.residual(both, found, field.power(found), tables)
        ny, nx = recovery.grid.shape
        for number in (0, 1):
            assert relative(torch.stack([part[number, :ny, :nx] for part in found]), expected) < error
        wanted = float(left.square().mean() / expected.square().mean())
        np.testing.assert_allclose(residual.numpy(), wanted, rtol=0.08)


def _typed(tables: Tables, dtype: torch.dtype) -> Tables:
    return {name: value.float() if "where" in name else value.to(dtype) for name, value in tables.items()}
