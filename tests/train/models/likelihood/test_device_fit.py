"""Claims about the fit of a device by the counts of all known pages: it comes nearer to the device, and no further."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from lightpage.calibration.calibrate import KnownPage, Registered
from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.likelihood.device_fit import DeviceFit
from lightpage.calibration.likelihood.interfaces import Derivatives
from lightpage.calibration.parameters import NAMES
from lightpage.calibration.sampling_table import SamplingTable
from lightpage.calibration.waves.wave_model import LaunchConditions
from lightpage.device.state import Device, Drift, Sensor
from lightpage.page.symbols import random_symbols, symbol_phases
from lightpage.recording.frame_pair import FramePair
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
SHIFT_ERROR_PX = 0.15
ERRORS = {
    "pipe_angle_rad": 2e-4,
    "launch_defocus_rad": 0.15,
    "camera_curvature_rad": -0.15,
    "in_phase_scale_x_relative": 4e-4,
    "quadrature_shift_y_px": SHIFT_ERROR_PX,
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
    return recorded(DIM)


def recorded(sensor: Sensor) -> Known:
    """Two known pages."""
    simulator = Simulator(PROFILE, Device(drift=Drift(shift_px=0), sensor=sensor), seed=3)
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


def test_a_verdict_allows_for_the_tilt_of_its_page() -> None:
    bright = recorded(Sensor())
    right = bright.registered(["in_phase_scale_x_relative"])
    tilted = replace(right, parameters=right.parameters + 0.1 * (np.array(NAMES) == "camera_tilt_x_rad"))
    one, other = (bright.refined(start).goodness for start in (right, tilted))
    assert one is not None
    assert other is not None
    assert other.bits_lost == pytest.approx(one.bits_lost, abs=0.01)


class Backwards:
    """Likelihood whose expected counts change the other way as the device's parameters change.

    Args:
        likelihood: right likelihood.
        parameters: parameters of the device from which they change, [P].
    """

    def __init__(self, likelihood: TorchLikelihood, parameters: np.ndarray) -> None:
        self.likelihood = likelihood
        self.parameters = parameters.astype(np.float32)
        self.apart_inputs = likelihood.apart_inputs

    def __call__(self, pair: FramePair, table: SamplingTable, phases: np.ndarray, nuisance: np.ndarray) -> Derivatives:
        return self.likelihood(pair, table, phases, nuisance)

    def expected(
        self, pair: FramePair, table: SamplingTable, phases: np.ndarray, nuisance: np.ndarray, places: np.ndarray
    ) -> np.ndarray:
        there = self.likelihood.expected(pair, table, phases, nuisance, places)
        if np.array_equal(table["parameters"], self.parameters):
            return there
        here = self.likelihood.expected(pair, table | {"parameters": self.parameters}, phases, nuisance, places)
        return 2 * here - there


def test_a_step_that_makes_the_counts_less_likely_is_not_taken(known: Known) -> None:
    start = known.registered(ERRORS)
    likelihood = Backwards(TorchLikelihood(PhaseEstimator(PROFILE, start.parameters).eval()), start.parameters)
    fit = DeviceFit(likelihood, TWIN, PROFILE, known.device.references, known.pages)
    found, _ = fit.refined(start, LaunchConditions(np.eye(6)[0] + 0j, BLUR))
    of_pages = np.array(["camera_tilt" in name or "_shift_" in name for name in NAMES])  # their mean tilt and shift
    np.testing.assert_array_equal(found.parameters[~of_pages], start.parameters[~of_pages])
    np.testing.assert_allclose(found.parameters[of_pages], start.parameters[of_pages], atol=SHIFT_ERROR_PX / 2)
    assert found.quadrature_phase == start.quadrature_phase
