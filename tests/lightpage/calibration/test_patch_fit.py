"""Claims about the fit: its derivative, its priors, what it recovers, and what outliers do to it."""

from dataclasses import replace

import numpy as np
import pytest

from lightpage.calibration.interfaces import BRANCHES
from lightpage.calibration.parameters import NAMES, PRIORS, indices, nominal
from lightpage.calibration.patch_fit import Design, fit_parameters
from lightpage.calibration.patches import Measurement, patches
from lightpage.train.models.twin import RayTwin, TorchTwin
from tests.lightpage.small import small_profile

PROFILE = small_profile()
TWIN = TorchTwin(RayTwin(PROFILE))
EVERY = list(range(len(NAMES)))


def measured(
    truth: np.ndarray, branches: tuple[str, ...] = ("direct", "x", "y"), piston: float = 0.0
) -> list[Measurement]:
    """Return error-free measurements of patches of a device with parameters `truth`, read with the nominal twin."""
    found, step = [], 0.5 * PROFILE.symbol_pitch_m
    for patch in patches(PROFILE):
        centre = np.array(patch.centre_m)
        stencil = centre + step * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
        rays = TWIN.trace(truth, stencil, np.tile(centre, (5, 1)))
        expected = TWIN.trace(nominal(), stencil[:1])
        for branch in branches:
            b = BRANCHES.index(branch)
            phases = rays.phases[b]
            pixels = TWIN.pixels(truth, rays.places[b, :1])[:, 0]
            read_at = TWIN.pixels(nominal(), expected.places[b, :1])[:, 0]
            carrier = np.array([[0.01, -0.015], [0.03, 0.01]])
            # read at another place than the true one, the phase is off by the carrier times the way
            phase = phases[0] + piston + np.sum((read_at - pixels) * carrier)
            found.append(
                Measurement(
                    branch=branch,
                    centre_m=centre,
                    pixels=pixels,
                    cameras=(0, 1),
                    read_at=read_at,
                    phase=float(phase),
                    carrier=carrier,
                    slope=np.array([phases[1] - phases[2], phases[3] - phases[4]]) / (2 * step),
                    significance=80.0,
                    symbols=100,
                )
            )
    return found


def some_device(seed: int, scale: float) -> np.ndarray:
    return scale * PRIORS * np.random.default_rng(seed).standard_normal(len(PRIORS))


def scattered(count: int = 12) -> list[Measurement]:
    """Measurements of nothing in particular: any branch, one or both cameras."""
    rng = np.random.default_rng(0)
    return [
        Measurement(
            branch=("direct", "x", "y")[i % 3],
            centre_m=rng.uniform(-0.4e-3, 0.4e-3, 2),
            pixels=rng.uniform(0, 450, (2, 2)),
            cameras=(0, 1) if i % 2 else (0,),
            read_at=rng.uniform(0, 450, (2, 2)),
            phase=float(rng.uniform(-3, 3)),
            carrier=rng.normal(size=(2, 2)) * 0.01,
            slope=rng.normal(size=2) * 1e3,
            significance=float(rng.uniform(20, 90)),
            symbols=100,
        )
        for i in range(count)
    ]


class TestJacobian:
    @pytest.mark.parametrize("use_phase", [False, True])
    def test_it_equals_finite_differences_of_the_residuals(self, use_phase: bool) -> None:
        count, base = len(EVERY), some_device(1, 0.3)
        design = Design(TWIN, PROFILE, scattered())

        def residuals(vector: np.ndarray) -> np.ndarray:
            parameters = base + vector[:count] * PRIORS
            data = design.residuals(parameters, vector[count], use_phase=use_phase)
            return np.concatenate([data, vector[:count]])

        zero = np.zeros(count + 1)
        by_hand = np.stack(
            [(residuals(zero + step) - residuals(zero - step)) / 2e-4 for step in 1e-4 * np.eye(len(zero))], axis=1
        )
        got = design.jacobian(base, EVERY, PRIORS, use_phase=use_phase)
        assert got.shape == by_hand.shape
        for column, name in enumerate([*NAMES, "piston"]):
            scale = max(1.0, np.abs(by_hand[:, column]).max())
            assert np.abs(got[:, column] - by_hand[:, column]).max() < 2e-3 * scale, name


class TestRecovery:
    def test_places_and_slopes_give_the_device_back(self) -> None:
        truth = some_device(2, 0.5)
        found = fit_parameters(TWIN, PROFILE, measured(truth), nominal(), EVERY, use_phase=False, evaluations=30)
        predicted, expected = (TWIN.trace(p, patch_centres()) for p in (found.parameters, truth))
        assert abs(found.parameters[0] - truth[0]) < 0.05 * PRIORS[0]
        for b in range(3):
            pixels, right = (TWIN.pixels(p, r.places[b]) for p, r in ((found.parameters, predicted), (truth, expected)))
            assert np.abs(pixels - right).max() < 0.1
        assert found.cost < 0.02

    def test_phases_at_their_true_places_sharpen_it_to_milliradians(self) -> None:
        truth = some_device(3, 0.5)
        start = truth + some_device(4, 0.003)
        data = measured(truth, piston=2.5)
        found = fit_parameters(TWIN, PROFILE, data, start, EVERY, use_phase=True)
        predicted, expected = (TWIN.trace(p, patch_centres()).phases[:3] for p in (found.parameters, truth))
        off = np.angle(np.exp(1j * (predicted + found.piston - expected - 2.5)))
        before = np.angle(np.exp(1j * (TWIN.trace(start, patch_centres()).phases[:3] - expected)))
        assert np.abs(off).max() < 5e-3 < 0.05 < np.abs(before).max()
        assert found.cost < 1e-3
        assert np.exp(1j * found.piston) == pytest.approx(np.exp(2.5j), abs=0.01)
        ignored = [replace(m, carrier=np.zeros((2, 2))) for m in data]
        wrong = fit_parameters(TWIN, PROFILE, ignored, truth, EVERY, use_phase=True)
        assert wrong.cost > 100 * found.cost

    def test_a_few_outliers_do_little(self) -> None:
        truth = some_device(6, 0.3)
        data = measured(truth)
        spoiled = [replace(m, pixels=m.pixels + 20) if i % 9 == 4 else m for i, m in enumerate(data)]
        robust = fit_parameters(TWIN, PROFILE, spoiled, truth, EVERY, use_phase=False)
        both = robust.parameters, truth
        places, expected = (TWIN.pixels(p, TWIN.trace(p, patch_centres()).places[0]) for p in both)
        assert np.sqrt(np.mean((places - expected) ** 2)) < 0.5

    def test_a_patch_on_one_camera_says_nothing_of_the_other_and_no_phase(self) -> None:
        one_camera = [replace(m, cameras=(0,)) for m in measured(some_device(8, 0.3), ("direct",))]
        design = Design(TWIN, PROFILE, one_camera)
        jacobian = design.jacobian(nominal(), EVERY, PRIORS, use_phase=True)
        data = jacobian[: -len(EVERY)]
        assert np.abs(data[:, indices("quadrature")]).max() == 0
        assert np.abs(data[:, indices("in_phase")]).max() > 1
        assert np.abs(data[:, len(EVERY)]).max() == 0


class TestPriors:
    def test_held_parameters_stay_where_they_are(self) -> None:
        truth, start = some_device(9, 0.5), some_device(10, 0.2)
        free = indices("in_phase", "quadrature")
        found = fit_parameters(TWIN, PROFILE, measured(truth, ("direct",)), start, free, use_phase=False)
        held = [i for i in EVERY if i not in free]
        np.testing.assert_array_equal(found.parameters[held], start[held])
        np.testing.assert_array_equal(found.deviations[held], PRIORS[held])
        assert (np.abs(found.parameters[free] - start[free]) > 0).all()
        assert (found.deviations[free] < PRIORS[free]).all()

    def test_what_the_data_do_not_show_stays_at_the_centre_with_the_priors_deviation(self) -> None:
        # light that met no wall knows nothing of the walls
        truth = only("pipe_centre_x_m", -0.5 * PRIORS[NAMES.index("pipe_centre_x_m")])
        free, centre = indices("walls"), 0.3 * PRIORS
        middle = [m for m in measured(truth, ("direct",)) if abs(m.centre_m[0]) < 0.3e-3]
        assert len(middle) == 6
        blind = fit_parameters(TWIN, PROFILE, middle, nominal(), free, use_phase=False, centre=centre)
        np.testing.assert_allclose(blind.parameters[free], centre[free], rtol=1e-6)
        np.testing.assert_allclose(blind.deviations[free], PRIORS[free], rtol=1e-6)
        told = fit_parameters(TWIN, PROFILE, measured(truth), nominal(), free, use_phase=True, centre=centre)
        assert told.parameters[free[0]] == pytest.approx(truth[free[0]], rel=0.02)
        assert told.deviations[free[0]] < 0.1 * PRIORS[free[0]]


def patch_centres() -> np.ndarray:
    return np.array([patch.centre_m for patch in patches(PROFILE)])


def only(name: str, value: float) -> np.ndarray:
    vector = nominal()
    vector[NAMES.index(name)] = value
    return vector
