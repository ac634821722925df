"""Claims about the fit of a device by the counts of all known pages: it comes nearer to the device, and no further."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import pytest

from lightpage.calibration.calibrate import KnownPage, Registered
from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.likelihood import device_fit
from lightpage.calibration.likelihood.device_fit import DeviceFit
from lightpage.calibration.parameters import NAMES
from lightpage.calibration.waves.wave_model import LaunchConditions
from lightpage.device.state import Device, Drift, Sensor
from lightpage.page.symbols import random_symbols, symbol_phases
from lightpage.simulator.simulator import Simulator
from lightpage.simulator.true_optics import perfectly_calibrated
from lightpage.train.models.likelihood.estimator import PhaseEstimator
from lightpage.train.models.likelihood.torch_likelihood import TorchLikelihood
from lightpage.train.models.twin import RayTwin, TorchTwin
from tests.lightpage.small import small_profile

PROFILE = small_profile()
TWIN = TorchTwin(RayTwin(PROFILE))
DIM = Sensor(full_well_e=100)
BLUR = 0.09
"""Variance of the simulated modulator's blur."""
ERRORS = {
    "pipe_angle_rad": 2e-4,
    "launch_defocus_rad": 0.15,
    "camera_curvature_rad": -0.15,
    "in_phase_scale_x_relative": 4e-4,
    "quadrature_shift_y_px": 0.15,
    "quadrature_axial_rad": 0.1,
}
"""Errors of a registration, several times the deviations of a fit."""
TURN_ERROR_RAD = 0.05


@dataclass(frozen=True)
class Known:
    """True device, and its known pages."""

    device: CalibratedDevice
    pages: list[KnownPage]

    def registered(self, fitted: Iterable[str]) -> Registered:
        """Registration of which some parameters were fitted, with those of `ERRORS` and the turn wrong."""
        parameters = self.device.parameters.copy()
        deviations = np.zeros_like(parameters)
        for name in fitted:
            parameters[NAMES.index(name)] += ERRORS.get(name, 0.0)
            deviations[NAMES.index(name)] = 1.0
        turn = self.device.quadrature_phase_rad + TURN_ERROR_RAD
        return Registered(parameters, deviations, turn, 0.1, 0.5, 1.0, 0.5)

    def refined(self, start: Registered) -> Registered:
        likelihood = TorchLikelihood(PhaseEstimator(PROFILE, start.parameters).eval())
        fit = DeviceFit(likelihood, TWIN, PROFILE, self.device.references, self.pages)
        return fit.refined(start, LaunchConditions(np.eye(6)[0] + 0j, BLUR))[0]


@pytest.fixture(scope="module")
def known() -> Known:
    simulator = Simulator(PROFILE, Device(drift=Drift(shift_px=0), sensor=DIM), seed=3)
    written = random_symbols(PROFILE, 256, 2, np.random.default_rng(3))
    pages = [KnownPage(simulator.page(each), np.exp(1j * symbol_phases(each, 256))) for each in written]
    return Known(perfectly_calibrated(PROFILE, simulator.device, simulator.references()), pages)


def test_errors_of_all_kinds_shrink_to_the_stated_deviations(known: Known) -> None:
    found = known.refined(known.registered(ERRORS))
    for name, error in ERRORS.items():
        index = NAMES.index(name)
        missed = abs(found.parameters[index] - known.device.parameters[index])
        assert found.deviations[index] < 0.2 * abs(error), name
        assert missed < 4 * found.deviations[index], name
    assert abs(found.quadrature_phase - known.device.quadrature_phase_rad) < 0.1 * TURN_ERROR_RAD
    assert found.goodness is not None
    assert found.goodness.verdict == "good"


def test_parameters_that_were_not_fitted_are_held(known: Known) -> None:
    start = known.registered(["in_phase_scale_x_relative"])
    found = known.refined(start)
    held = np.array([name != "in_phase_scale_x_relative" for name in NAMES])
    np.testing.assert_array_equal(found.parameters[held], start.parameters[held])
    assert not found.deviations[held].any()


def test_a_step_that_makes_the_counts_less_likely_is_not_taken(known: Known, monkeypatch: pytest.MonkeyPatch) -> None:
    def backwards(gradient: np.ndarray, information: np.ndarray) -> object:
        right = solution(gradient, information)
        return right._replace(step=-right.step)

    solution = device_fit._solution
    monkeypatch.setattr(device_fit, "_solution", backwards)
    start = known.registered(ERRORS)
    found = known.refined(start)
    np.testing.assert_array_equal(found.parameters, start.parameters)
    assert found.quadrature_phase == start.quadrature_phase
