"""Claims about maximum likelihood: its derivatives are those of the likelihood, and its steps read pages."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from lightpage.calibration.calibrate import KnownPage
from lightpage.calibration.likelihood.counts import CountStatistics
from lightpage.calibration.likelihood.known_page_fit import KnownPageFit
from lightpage.calibration.likelihood.measure import estimator_table, light_table
from lightpage.calibration.likelihood.table import FLAT_FIELD, count_tensors, pilot_tensors
from lightpage.calibration.sampling_table import APART, SamplingTable
from lightpage.calibration.waves.wave_fit import WaveFit
from lightpage.calibration.waves.wave_model import LaunchConditions
from lightpage.device.state import CameraPose, Device, Drift, Sensor, SlmDefects
from lightpage.export.estimated_device import coarse_start_pays
from lightpage.page.correction import wrapped
from lightpage.page.pilots import Pilots
from lightpage.page.symbols import random_symbols, symbol_phases
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.execution.estimator_graph import DEVIATION_PRECISION, EARLY_STEPS, NO_DEVIATIONS
from lightpage.runtime.model.execution.estimator_graph import NOISE as NOISE_ROWS
from lightpage.runtime.recalibration.noise import KnownPhases
from lightpage.simulator.simulator import Simulator
from lightpage.simulator.true_optics import perfectly_calibrated
from lightpage.train.models.likelihood.estimator import Estimate, Likelihood, Operators, Page, PhaseEstimator
from lightpage.train.models.likelihood.modulator import summed, to_samples
from lightpage.train.models.likelihood.torch_likelihood import TorchLikelihood
from lightpage.train.models.prediction import expected_phasors
from lightpage.train.models.twin import RayTwin, TorchTwin
from lightpage.train.models.waves import THINNED, Fidelity
from tests.lightpage.small import random_phases, small_profile

PROFILE = small_profile()
TWIN = TorchTwin(RayTwin(PROFILE))
FINE = Fidelity(0.002, 0.003)
STILL = Device(drift=Drift(shift_px=0))
MASK = np.random.default_rng(0).random(PROFILE.page_shape) < 0.05
NOISE = torch.tensor([1.0, 0.0])
SURE = 1e6
STEPS = 3
KNOCK_PX = np.array([0.1, -0.05])


@pytest.fixture(scope="module", autouse=True)
def without_gradients() -> Iterator[None]:
    with torch.no_grad():
        yield


def written(seed: int) -> np.ndarray:
    return np.asarray(random_symbols(PROFILE, 256, 1, np.random.default_rng(seed))[0])


def tensors(table: SamplingTable) -> dict[str, torch.Tensor]:
    return {name: torch.from_numpy(np.array(value)) for name, value in table.items()}


@dataclass(frozen=True)
class Posed:
    """A page whose counts have one variance, so that their log-likelihood is a sum of squares."""

    estimator: PhaseEstimator
    operators: Operators
    table: dict[str, torch.Tensor]
    page: Page

    VARIANCE = 4.0

    def at(
        self, phases: np.ndarray, nuisance: np.ndarray, *, coarse: bool = False, kappa: float | np.ndarray = SURE
    ) -> Likelihood:
        p = torch.from_numpy(kappa * np.stack([np.cos(phases), np.sin(phases)])).float()
        still = torch.zeros_like(self.operators.illumination[0])
        estimate = Estimate(p, torch.from_numpy(nuisance).float(), still)
        cameras = self.estimator.recovery.cameras(*(self.table[name] for name in APART if name in self.table))
        return self.estimator.likelihood(self.operators, self.table, self.page, estimate, cameras, coarse=coarse)

    def logarithm(
        self, phases: np.ndarray, nuisance: np.ndarray, *, coarse: bool = False, kappa: float | np.ndarray = SURE
    ) -> float:
        page = self.page.thinned if coarse else self.page
        expected = self.at(phases, nuisance, coarse=coarse, kappa=kappa).expected
        missed = (page.counts - expected).double() * page.lit
        return -float(missed.square().sum()) / (2 * self.VARIANCE) * (THINNED**2 if coarse else 1)

    def slope(
        self, phases: np.ndarray, nuisance: np.ndarray, by: np.ndarray, ahead: np.ndarray, *, coarse: bool = False
    ) -> float:
        """Derivative of the logarithm along changes of phases and nuisance parameters."""
        there, back = (self.logarithm(phases + sign * by, nuisance + sign * ahead, coarse=coarse) for sign in (1, -1))
        return (there - back) / 2


@pytest.fixture(scope="module", params=[0.0, 0.3], ids=["one plane", "cameras apart"])
def posed(request: pytest.FixtureRequest) -> Posed:
    slm = SlmDefects(unmodulated_relative=0.1)
    poses = {
        "in_phase_camera": CameraPose(axial_rad=request.param),
        "quadrature_camera": CameraPose(axial_rad=-request.param),
    }
    simulator = Simulator(PROFILE, STILL.model_copy(update={"slm": slm, **poses}), seed=1)
    device = perfectly_calibrated(PROFILE, simulator.device, simulator.references())
    assert bool(device.apart_inputs) == bool(request.param)
    line = tuple(np.linspace(0, 300, 9).tolist())
    even = CountStatistics(expected=line, mean=line, variance=(Posed.VARIANCE,) * len(line))
    conditions = LaunchConditions(np.eye(6)[0] * 1.4 + 0.1j, 0.09)
    table = tensors(light_table(TWIN, device, conditions) | count_tensors((even, even), 1.0))
    estimator = PhaseEstimator(PROFILE, device.parameters, forward=FINE, backward=FINE).eval()
    pair = simulator.page(written(1))
    page, _ = estimator.measured(table, torch.from_numpy(pair.in_phase), torch.from_numpy(pair.quadrature))
    return Posed(estimator, estimator.operators(table), table, page)


PHASES = random_phases(PROFILE, 3)
NUISANCE = np.array([0.9, -0.3, 0.05, -0.03, 0.1, -0.2])


def test_the_derivative_by_phases_is_that_of_the_likelihood(posed: Posed) -> None:
    by_phase, rng = posed.at(PHASES, NUISANCE).by_phase.numpy().astype(float), np.random.default_rng(0)
    for _ in range(3):
        direction = 0.01 * rng.standard_normal(PHASES.shape)
        slope = posed.slope(PHASES, NUISANCE, direction, np.zeros(6))
        assert slope == pytest.approx(np.sum(direction * by_phase), abs=1e-4 * float(np.linalg.norm(by_phase)))


def test_the_derivative_by_amplitudes_is_that_of_the_likelihood(posed: Posed) -> None:
    kappa = 5 + 0.1 * np.random.default_rng(0).standard_normal(PHASES.shape)
    lengths = [float(expected_phasors(torch.tensor([each, 0.0]))[0]) for each in (4.9, 5.1)]
    by_amplitude = posed.at(PHASES, NUISANCE, kappa=5.0).by_amplitude.numpy().astype(float)
    there, back = (posed.logarithm(PHASES, NUISANCE, kappa=each) for each in (kappa, 10 - kappa))
    expected = (lengths[1] - lengths[0]) / 0.2 * np.sum((kappa - 5) * by_amplitude)
    largest = 0.1 * (lengths[1] - lengths[0]) / 0.2 * float(np.linalg.norm(by_amplitude))
    assert (there - back) / 2 == pytest.approx(expected, abs=0.01 * largest)


def test_the_derivative_by_nuisance_parameters_is_that_of_the_likelihood(posed: Posed) -> None:
    found = posed.at(PHASES, NUISANCE).by_nuisance.numpy()
    gain = complex(*NUISANCE[:2])
    ways = np.zeros((6, 6))
    ways[0, :2], ways[1, :2] = (gain.real, gain.imag), (-gain.imag, gain.real)  # relative change, and phase
    ways[range(2, 6), range(2, 6)] = 1
    step = 0.003
    expected = [posed.slope(PHASES, NUISANCE, np.zeros_like(PHASES), step * way) / step for way in ways]
    np.testing.assert_allclose(found, expected, rtol=0.01, atol=0.001 * np.abs(found[2:]).max())


@pytest.mark.parametrize("posed", [0.0], indirect=True, ids=["one plane"])
def test_the_derivative_on_the_thinned_grid_is_that_of_its_samples(posed: Posed) -> None:
    found = posed.at(PHASES, NUISANCE, coarse=True)
    rng = np.random.default_rng(0)
    direction = 0.01 * rng.standard_normal(PHASES.shape)
    slope = posed.slope(PHASES, NUISANCE, direction, np.zeros(6), coarse=True)
    by_phase = found.by_phase.numpy().astype(float)
    assert slope == pytest.approx(np.sum(direction * by_phase), abs=1e-4 * float(np.linalg.norm(by_phase)))
    tilt = np.eye(6)[2] * 0.003
    slope = posed.slope(PHASES, NUISANCE, np.zeros_like(PHASES), tilt, coarse=True) / 0.003
    assert float(found.by_nuisance[2]) == pytest.approx(slope, rel=0.02)
    exact = posed.at(PHASES, NUISANCE).by_phase.numpy().astype(float)
    assert np.corrcoef(by_phase.ravel(), exact.ravel())[0, 1] > 0.95


@pytest.mark.parametrize("posed", [0.0], indirect=True, ids=["one plane"])
def test_the_way_back_is_the_adjoint_of_the_way_there(posed: Posed) -> None:
    waves, matrices = posed.estimator.waves, posed.operators.forward
    rng = np.random.default_rng(0)
    page, field = (
        torch.from_numpy(rng.standard_normal((2, *shape))).float()
        for shape in (posed.operators.illumination[0].shape, posed.page.lit.shape)
    )
    there, back = waves.to_camera(matrices, page).double(), waves.to_page(matrices, field).double()
    left, right = float((there * field).sum()), float((page * back).sum())
    assert left == pytest.approx(right, abs=1e-6 * float(there.norm() * field.norm()))


@dataclass(frozen=True)
class Fitted:
    """An estimator of a calibrated device, with all that its table holds but pilots."""

    estimator: PhaseEstimator
    table: SamplingTable

    def read(
        self, pair: FramePair, phases: np.ndarray, turn: float = 0.0, steps: int = STEPS
    ) -> tuple[list[Estimate], list[float]]:
        """Estimates of a page from the first one on, and chi-square at each but the last; pilots may be turned."""
        table = tensors(self.table | pilot_tensors(Pilots(MASK, phases[MASK] + turn)))
        table["deviation_precision"] = torch.tensor(NO_DEVIATIONS)
        operators = self.estimator.operators(table)
        frames = torch.from_numpy(pair.in_phase), torch.from_numpy(pair.quadrature)
        estimate, page, _ = self.estimator.first(operators, table, NOISE, *frames)
        estimates, chi_squares = [estimate], []
        for number in range(steps):
            early = number < EARLY_STEPS
            coarse = early and self.estimator.coarse_start
            found = self.estimator.likelihood(operators, table, page, estimates[-1], coarse=coarse)
            estimate, chi_square = self.estimator.advanced(table, page, estimates[-1], found, NOISE, start=early)
            estimates.append(estimate)
            chi_squares.append(float(chi_square))
        return estimates, chi_squares


def decoded(estimate: Estimate) -> np.ndarray:
    return np.asarray(np.arctan2(estimate.p[1].numpy(), estimate.p[0].numpy()))


def fitted_to(state: Device) -> Fitted:
    """The estimator of a device, with the statistics of one page of it."""
    simulator, symbols = Simulator(PROFILE, state, seed=1), written(1)
    pair, references = simulator.page(symbols), simulator.references()
    device = perfectly_calibrated(PROFILE, state, references)
    known = KnownPage(pair, np.exp(1j * symbol_phases(symbols, 256)))
    waves = WaveFit(TWIN, PROFILE, pair, references, known.symbols)
    conditions = waves.fit(device.parameters, device.quadrature_phase_rad, ("in_phase",)).conditions
    estimator = PhaseEstimator(PROFILE, device.parameters).eval()
    likelihood = TorchLikelihood(estimator)
    statistics = KnownPageFit(likelihood, light_table(TWIN, device, conditions), [known], device.modulation).statistics(
        conditions
    )
    return Fitted(estimator, estimator_table(likelihood, TWIN, device, [known], statistics))


@pytest.fixture(scope="module")
def fitted() -> Fitted:
    return fitted_to(STILL)


@pytest.fixture(scope="module")
def pages() -> tuple[np.ndarray, FramePair, FramePair]:
    """Phases of a page, its frames, and those of the same page after a knock."""
    simulator, symbols = Simulator(PROFILE, STILL, seed=2), written(2)
    before = simulator.page(symbols)
    simulator.knock((KNOCK_PX[0], KNOCK_PX[1]))
    return symbol_phases(symbols, 256), before, simulator.page(symbols)


def test_every_step_comes_nearer_to_the_page(fitted: Fitted, pages: tuple[np.ndarray, FramePair, FramePair]) -> None:
    phases, pair, _ = pages
    estimates, chi_squares = fitted.read(pair, phases)
    errors = [wrapped(decoded(estimate) - phases)[~MASK] for estimate in estimates]
    deviations = [float(np.sqrt(np.mean(error**2))) for error in errors]
    information = fitted.table["information"][~MASK]
    assert deviations == sorted(deviations, reverse=True)
    assert deviations[-1] < 0.02 < 0.05 < deviations[0]
    assert 0.7 < np.mean(errors[-1] ** 2 * information) < 1.5  # as the information promises
    assert chi_squares[-1] == pytest.approx(1, abs=0.1)
    assert chi_squares[0] > 2


def test_in_dim_light_concentrations_tell_which_symbols_are_right() -> None:
    dim = STILL.model_copy(update={"sensor": Sensor(full_well_e=32, exposure_relative=0.06)})
    phases = symbol_phases(written(2), 256)
    fitted = fitted_to(dim)
    fitted.estimator.coarse_start = False
    estimates, _ = fitted.read(Simulator(PROFILE, dim, seed=2).page(written(2)), phases)
    agreement = np.cos(decoded(estimates[-1]) - phases)[~MASK]
    concentrations = np.hypot(*estimates[-1].p.numpy())[~MASK]
    sure = concentrations > np.median(concentrations)
    assert 0.2 < agreement.mean() < 0.9  # neither lost nor all right
    assert agreement[sure].mean() > agreement[~sure].mean() + 0.1


@pytest.mark.parametrize(("electrons", "exposure", "pays"), [(15_000, 1, True), (32, 1, False), (32, 0.06, False)])
def test_a_coarse_start_pays_in_bright_light_only(electrons: float, exposure: float, *, pays: bool) -> None:
    state = STILL.model_copy(update={"sensor": Sensor(full_well_e=electrons, exposure_relative=exposure)})
    fitted = fitted_to(state)
    phases = symbol_phases(written(2), 256)
    known = KnownPhases(Simulator(PROFILE, state, seed=2).page(written(2)), phases)
    table = fitted.table | {NOISE_ROWS: np.array([[1, 0]], np.float32), DEVIATION_PRECISION: NO_DEVIATIONS}
    assert coarse_start_pays(fitted.estimator, table, known, MASK) == pays


def test_a_shift_of_the_image_is_found(fitted: Fitted, pages: tuple[np.ndarray, FramePair, FramePair]) -> None:
    phases, *pairs = pages
    before, after = (fitted.read(pair, phases)[0][-1].nuisance.numpy() for pair in pairs)
    np.testing.assert_allclose(after[4:] - before[4:], KNOCK_PX, atol=0.015)
    np.testing.assert_allclose(before[2:], 0, atol=0.02)


def test_turned_pilots_turn_the_answer_and_the_gain(
    fitted: Fitted, pages: tuple[np.ndarray, FramePair, FramePair]
) -> None:
    phases, pair, _ = pages
    turn = 0.7
    one, other = (fitted.read(pair, phases, by, steps=2)[0] for by in (0.0, turn))
    for straight, turned in zip(one, other, strict=True):
        assert np.abs(wrapped(decoded(turned) - decoded(straight) - turn)).max() < 1e-3
        gain, found = (complex(*each.nuisance[:2].tolist()) for each in (straight, turned))
        assert found == pytest.approx(gain * np.exp(-1j * turn), abs=1e-3)


def test_a_flat_field_is_taken_off_the_answer(fitted: Fitted, pages: tuple[np.ndarray, FramePair, FramePair]) -> None:
    phases, pair, _ = pages
    flat = np.random.default_rng(0).normal(0, 0.05, phases.shape).astype(np.float32)
    flat -= flat[MASK].mean()
    corrected = replace(fitted, table=fitted.table | {FLAT_FIELD: flat})
    without, corrected_answer = (decoded(each.read(pair, phases)[0][-1]) for each in (fitted, corrected))
    np.testing.assert_allclose(wrapped(corrected_answer - without), -flat, atol=0.004)


def test_deviations_of_the_modulators_samples_are_told_from_the_symbols_phases(fitted: Fitted) -> None:
    phases, samples = symbol_phases(written(2), 256), fitted.estimator.samples
    table = tensors(fitted.table | pilot_tensors(Pilots(MASK, phases[MASK])))
    operators = fitted.estimator.operators(table)
    size = operators.illumination[0].shape
    drawn = torch.from_numpy(np.random.default_rng(0).normal(0, 0.05, size)).float()
    deviations = drawn - to_samples(summed(drawn, samples) / samples**2, samples)
    p = torch.from_numpy(SURE * np.stack([np.cos(phases), np.sin(phases)])).float()
    nuisance, grid = torch.eye(6)[0], fitted.estimator.recovery.grid.shape
    references = torch.full((2, *grid), 50.0)
    even, still = torch.ones(grid), torch.zeros(size)
    unknown = Page(references, references, even, even)
    expected = fitted.estimator.likelihood(operators, table, unknown, Estimate(p, nuisance, deviations)).expected
    page = Page(expected, references, even, even)
    errors = []
    for precision in (1e12, 100.0):
        table["deviation_precision"] = torch.tensor(precision)
        estimate = Estimate(p, nuisance, still)
        for _ in range(STEPS + 1):
            derivatives = fitted.estimator.likelihood(operators, table, page, estimate)
            estimate, _ = fitted.estimator.advanced(table, page, estimate, derivatives, torch.tensor([0.0, 1e-6]))
        errors.append(float(np.mean(wrapped(decoded(estimate) - phases) ** 2)))
    assert errors[1] < 0.95 * errors[0]
    assert np.corrcoef(estimate.deviations.ravel(), deviations.ravel())[0, 1] > 0.6
