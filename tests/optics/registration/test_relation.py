"""Claims about the cameras' relation: a known page places both cameras, whatever the reference."""

from __future__ import annotations

import numpy as np
import pytest

from optics.device import Aberration, CameraPose, Device, Drift, Homodyne, Reference, Sensor
from optics.grid import field_grid
from optics.page import symbol_phases
from optics.registration.parameters import indices
from optics.registration.relation import CameraRelation
from optics.simulator import Simulator, true_parameters
from tests.optics.small import small_profile
from train.twin import RayTwin, TorchTwin

PROFILE = small_profile()
TURN = np.deg2rad(-90 + 3)


@pytest.mark.parametrize(("ratio", "full_well_e"), [(1.3, 15_000.0), (3.0, 15_000.0), (1.6, 100.0)])
def test_both_cameras_and_the_angle_between_the_arms_come_back(ratio: float, full_well_e: float) -> None:
    device = Device(
        in_phase_camera=CameraPose(scale_relative_error=2e-3, rotation_deg=0.1, shift_x_px=1.0),
        quadrature_camera=CameraPose(scale_relative_error=-1e-3, rotation_deg=-0.1, shift_y_px=-2.0),
        aberration=Aberration(distortion_relative=0),
        reference=Reference(amplitude_ratio=ratio),
        homodyne=Homodyne(quadrature_error_deg=3, quadrature_sign=-1, quadrature_gain=0.9),
        sensor=Sensor(full_well_e=full_well_e),
        drift=Drift(shift_px=0),
    )
    simulator = Simulator(PROFILE, device, seed=1)
    symbols = np.random.default_rng(0).integers(256, size=PROFILE.page_shape).astype(np.uint8)
    pair, references = simulator.page(symbols), simulator.references()
    truth = true_parameters(PROFILE, device)
    start = truth.copy()
    start[indices("in_phase")] += [0.3, 0.1, 1e-3, 0, 1e-3, 0]
    start[indices("quadrature")] += [-0.4, 0.2, -1e-3, 1e-3, 0, 2e-3]
    twin = TorchTwin(RayTwin(PROFILE))
    relation = CameraRelation(twin, PROFILE, start, pair, references, np.exp(1j * symbol_phases(symbols, 256)))
    found, turn = relation.fit(TURN + np.deg2rad(8))

    grid = field_grid(PROFILE)
    half = np.array([PROFILE.page_width_m, PROFILE.page_height_m]) / 2
    places = np.stack(np.meshgrid(grid.x_m, grid.y_m), axis=-1).reshape(-1, 2)
    places = places[np.all(np.abs(places) < half, axis=1)]

    def off(parameters: np.ndarray) -> np.ndarray:
        """Largest error of either camera's place, pixels."""
        errors = twin.pixels(parameters, places) - twin.pixels(truth, places)
        return np.asarray(np.linalg.norm(errors, axis=-1).max(axis=1))

    assert np.all(off(start) > 0.4)
    assert np.all(off(found) < 0.1)
    assert abs(np.rad2deg(turn - TURN)) < 0.3
    poses = np.r_[indices("in_phase"), indices("quadrature")]
    assert np.array_equal(np.delete(found, poses), np.delete(truth, poses))
