"""Claims about field recovery: how near it comes to the true field, and what its residual tells."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from analysis.comparison.methods.oracle import without_signal_power
from lightpage.calibration.samplers import FieldSampler
from lightpage.calibration.sampling_table import monomial_powers, needed_apart
from lightpage.device.state import Aberration, CameraPose, Device, Drift, Homodyne, Reference, Sensor
from lightpage.errors import InvalidInputError
from lightpage.recording.frame_pair import FramePair
from lightpage.simulator.cameras import resample
from lightpage.simulator.simulator import Simulator
from lightpage.simulator.true_optics import TrueOptics, true_parameters
from lightpage.train.models.field import ROUNDS, FieldRecovery, TorchFieldSolver
from lightpage.train.models.presets import REFLECTIONS
from lightpage.waves.grid import field_grid
from tests.lightpage.small import small_profile

PROFILE = small_profile()
SHIFTS_PX = (0.5, 4.3)
ERROR_DEG = 3.0


@dataclass(frozen=True)
class Recorded:
    """A frame pair with the true field against the reference, on the common grid."""

    pair: FramePair
    references: FramePair
    truth: np.ndarray
    turn: float
    exit_field: np.ndarray
    optics: TrueOptics
    apart: dict[str, np.ndarray]


def record(
    sign: int = 1,
    ratio: float = 1.6,
    full_well_e: float = 15_000.0,
    axial: tuple[float, float] = (0.0, 0.0),
    tilt_rad: float = 0.0,
) -> Recorded:
    device = Device(
        in_phase_camera=CameraPose(
            shift_x_px=SHIFTS_PX[0], axial_rad=axial[0], tilt_x_rad=tilt_rad, tilt_y_rad=tilt_rad / 2
        ),
        quadrature_camera=CameraPose(
            shift_x_px=SHIFTS_PX[1], axial_rad=axial[1], tilt_x_rad=-tilt_rad, tilt_y_rad=-tilt_rad / 2
        ),
        aberration=Aberration(distortion_relative=0),
        reference=Reference(amplitude_ratio=ratio),
        homodyne=Homodyne(quadrature_error_deg=ERROR_DEG, quadrature_sign=sign),
        sensor=Sensor(full_well_e=full_well_e),
        drift=Drift(piston_rad=0, shift_px=0),
    )
    simulator = Simulator(PROFILE, device, seed=1, steps=16)
    symbols = np.random.default_rng(0).integers(256, size=PROFILE.page_shape).astype(np.uint8)
    page, optics, grid = simulator.simulate(symbols), simulator.optics, field_grid(PROFILE)
    reference = optics.reference()
    field = optics.camera_field(page.exit_field) * np.exp(1j * page.piston) * np.exp(-1j * np.angle(reference))
    x, y = np.meshgrid(grid.x_m, grid.y_m)
    real, imaginary = (resample(part, *optics.camera_axes_m, x, y) for part in (field.real, field.imag))
    turn = sign * np.pi / 2 + np.deg2rad(ERROR_DEG)
    parameters = true_parameters(PROFILE, device)
    apart = needed_apart(parameters, PROFILE)
    truth = real + 1j * imaginary
    return Recorded(page.pair, simulator.references(), truth, turn, page.exit_field, optics, apart)


def registration(shifts_px: tuple[float, float] = SHIFTS_PX) -> np.ndarray:
    """Cameras at their nominal scale, shifted in x."""
    corner, powers = PROFILE.corner_m, monomial_powers()
    cubics = np.zeros((2, 2, len(powers)), np.float32)
    cubics[:, 0, powers.index((1, 0))] = cubics[:, 1, powers.index((0, 1))] = corner / PROFILE.camera.pitch_m
    cubics[:, 0, powers.index((0, 0))] = (PROFILE.camera.columns_px - 1) / 2 + np.array(shifts_px)
    cubics[:, 1, powers.index((0, 0))] = (PROFILE.camera.rows_px - 1) / 2
    return cubics


def solve(
    recorded: Recorded,
    turn: float | None = None,
    pair: FramePair | None = None,
    where: np.ndarray | None = None,
    rounds: int = ROUNDS,
) -> tuple[np.ndarray, np.ndarray]:
    angle = recorded.turn if turn is None else turn
    return TorchFieldSolver(FieldRecovery(PROFILE, rounds=rounds))(
        recorded.pair if pair is None else pair,
        recorded.references,
        registration() if where is None else where,
        np.array([np.cos(angle), np.sin(angle)], np.float32),
        {},
    )


def recovered(page: Recorded, recovery: FieldRecovery) -> np.ndarray:
    """The field on the usual grid."""
    homodyne, usual = np.array([np.cos(page.turn), np.sin(page.turn)], np.float32), field_grid(PROFILE)
    field, _ = TorchFieldSolver(recovery)(page.pair, page.references, registration(), homodyne, page.apart)
    return FieldSampler(field, recovery.grid)(np.stack(np.meshgrid(usual.x_m, usual.y_m), axis=-1))


def inside() -> np.ndarray:
    """Mask of the grid inside the page's image."""
    grid = field_grid(PROFILE)
    in_x = np.abs(grid.x_m) < 0.95 * PROFILE.page_width_m / 2
    in_y = np.abs(grid.y_m) < 0.95 * PROFILE.page_height_m / 2
    return np.asarray(in_x[None, :] & in_y[:, None])


def error_db(field: np.ndarray, truth: np.ndarray) -> float:
    """Power of the error over that of the truth inside the page, the best complex scale given for free."""
    got, expected = field[inside()], truth[inside()]
    scale = np.vdot(got, expected) / np.vdot(got, got)
    return float(10 * np.log10(np.sum(np.abs(expected - scale * got) ** 2) / np.sum(np.abs(expected) ** 2)))


def left_over(field: np.ndarray, residual: np.ndarray) -> float:
    return float((residual[:, inside()] ** 2).mean() / (np.abs(field[inside()]) ** 2).mean())


@pytest.fixture(scope="module")
def recorded() -> Recorded:
    return record()


class TestAccuracy:
    @pytest.mark.parametrize("sign", [1, -1])
    def test_the_field_comes_back_within_25_db_whichever_way_q_is_mounted(self, sign: int, recorded: Recorded) -> None:
        page = recorded if sign == 1 else record(sign)
        field, _ = solve(page)
        assert error_db(field, page.truth) < -25
        overlap = np.vdot(field[inside()], page.truth[inside()])
        assert abs(np.angle(overlap)) < 0.01

    @pytest.mark.parametrize(("rounds", "binning", "step_px", "expected_db"), [(ROUNDS, 1, 3, -10.1), (0, 2, 2, -10.2)])
    def test_hurry_and_a_coarser_grid_cost_what_the_documents_say(
        self, rounds: int, binning: int, step_px: int, expected_db: float
    ) -> None:
        dim, grid = record(full_well_e=32), field_grid(PROFILE, step_px)
        field = recovered(dim, FieldRecovery(PROFILE, rounds=rounds, binning=binning, grid=grid))
        assert error_db(field, dim.truth) == pytest.approx(expected_db, abs=0.5)

    @pytest.mark.parametrize(("full_well_e", "expected_db"), [(15_000, -29.0), (32, -12.2)])
    def test_reflections_come_as_near_as_descent(
        self, full_well_e: float, expected_db: float, recorded: Recorded
    ) -> None:
        page = recorded if full_well_e > 1000 else record(full_well_e=full_well_e)
        found = error_db(recovered(page, FieldRecovery(PROFILE, reflections=REFLECTIONS)), page.truth)
        assert found == pytest.approx(expected_db, abs=0.5)

    @pytest.mark.parametrize(
        ("full_well_e", "step_px", "tilt_rad", "expected_db"),
        [(15_000, 2, 0.0, -25.6), (15_000, 3, 0.0, -15.6), (32, 2, 0.0, -9.0), (15_000, 2, 0.3, -25.6)],
    )
    def test_cameras_that_stand_apart_show_one_field(
        self, full_well_e: float, step_px: int, tilt_rad: float, expected_db: float
    ) -> None:
        page = record(full_well_e=full_well_e, axial=(0.8, -0.7), tilt_rad=tilt_rad)
        grid = field_grid(PROFILE, step_px)
        assert error_db(recovered(page, FieldRecovery(PROFILE, grid=grid)), page.truth) == pytest.approx(
            expected_db, abs=0.5
        )

    def test_an_oracle_is_spared_what_the_signal_alone_brings_to_each_camera(self) -> None:
        page = record(axial=(0.4, -0.3))
        plain = replace(page, pair=without_signal_power(page.pair, page.exit_field, (0.0, 0.0), page.optics))
        assert error_db(recovered(plain, FieldRecovery(PROFILE, with_signal_power=False)), page.truth) < -28

    def test_blocks_that_the_references_blocks_are_no_multiple_of_are_refused(self) -> None:
        with pytest.raises(InvalidInputError, match="binning"):
            FieldRecovery(PROFILE, binning=3)


class TestClosedRoot:
    @pytest.mark.parametrize("turn_deg", [70.0, 90.0, -105.0])
    def test_an_even_weak_field_is_solved_without_any_round(self, turn_deg: float) -> None:
        turn, field = np.deg2rad(turn_deg), 0.3 - 0.2j
        reference = np.full(PROFILE.frame_shape, 80.0)
        frames = [reference * abs(1 + field) ** 2, reference * abs(np.exp(1j * turn) + field) ** 2]
        got, residual = FieldRecovery(PROFILE, rounds=0)(
            *(torch.tensor(frame, dtype=torch.float32) for frame in (*frames, reference, reference)),
            torch.tensor(registration((0.0, 0.0))),
            torch.tensor([np.cos(turn), np.sin(turn)], dtype=torch.float32),
        )
        # away from the edges, where the light ends
        middle = (slice(60, -60), slice(60, -60))
        scale = float(torch.linalg.norm(got[:, *middle]) / np.sqrt(got[0][middle].numel()) / abs(field))
        np.testing.assert_allclose(got[0][middle] / scale, field.real, atol=2e-4)
        np.testing.assert_allclose(got[1][middle] / scale, field.imag, atol=2e-4)
        assert float(residual[:, *middle].abs().max()) < 1e-4 * scale


class TestResidual:
    def test_it_tells_a_wrong_angle_a_misplaced_camera_and_swapped_frames(self, recorded: Recorded) -> None:
        right = left_over(*solve(recorded))
        for wrong_deg in (-15, 15):
            assert left_over(*solve(recorded, turn=recorded.turn + np.deg2rad(wrong_deg))) > 1.15 * right
        moved = registration((SHIFTS_PX[0], SHIFTS_PX[1] + 3))
        assert left_over(*solve(recorded, where=moved)) > 2 * right
        swapped = FramePair(recorded.pair.quadrature, recorded.pair.in_phase)
        assert left_over(*solve(recorded, pair=swapped)) > 8 * right

    def test_it_cannot_tell_the_sign_of_q(self, recorded: Recorded) -> None:
        """The two equations are those of the conjugate field: only known symbols tell."""
        field, residual = solve(recorded)
        mirrored, same = solve(recorded, turn=-recorded.turn)
        np.testing.assert_allclose(mirrored, field.conj(), atol=1e-5)
        np.testing.assert_allclose(same, residual, atol=1e-5)


class TestDarkness:
    def test_where_the_reference_is_dark_there_is_neither_light_nor_nan(self, recorded: Recorded) -> None:
        def half_dark(frame: np.ndarray, stray: int) -> np.ndarray:
            dark = frame.copy()
            dark[:, : dark.shape[1] // 2] = stray
            return dark

        dimmed = replace(
            recorded,
            pair=FramePair(half_dark(recorded.pair.in_phase, 4), half_dark(recorded.pair.quadrature, 3)),
            references=FramePair(
                half_dark(recorded.references.in_phase, 0), half_dark(recorded.references.quadrature, 0)
            ),
        )
        field, residual = solve(dimmed)
        assert np.isfinite([*np.abs(field).ravel(), *residual.ravel()]).all()
        columns = field.shape[1]
        lit, plain = field[:, columns // 2 + 30 :], solve(recorded)[0][:, columns // 2 + 30 :]
        assert np.abs(field[:, : columns // 2 - 30]).max() < 0.05 * np.abs(lit).max()
        scale = np.vdot(lit, plain) / np.vdot(lit, lit)
        assert np.linalg.norm(plain - scale * lit) < 0.05 * np.linalg.norm(plain)

    def test_no_light_at_all_gives_no_nan(self, recorded: Recorded) -> None:
        black = FramePair(*(np.zeros(PROFILE.frame_shape, np.uint8) for _ in range(2)))
        field, residual = solve(replace(recorded, pair=black))
        assert np.isfinite(field).all()
        assert np.isfinite(residual).all()


class TestGain:
    def test_gain_of_either_camera_cancels(self, recorded: Recorded) -> None:
        def brighter(frames: FramePair) -> FramePair:
            return FramePair(frames.in_phase.astype(np.uint16) * 3, frames.quadrature.astype(np.uint16) * 7)

        same = replace(recorded, pair=brighter(recorded.pair), references=brighter(recorded.references))
        np.testing.assert_allclose(solve(same)[0], solve(recorded)[0], atol=1e-4)
