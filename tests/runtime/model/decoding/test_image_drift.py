"""The image's drift shows in the phases of pilots and safe decisions; pages that say nothing are left out."""

from unittest.mock import Mock

import numpy as np
import pytest

from lightpage.errors import BundleError, FrameError
from lightpage.page.levels import Levels
from lightpage.page.pilots import Pilots
from lightpage.page.symbols import symbol_phases
from lightpage.runtime.model.decoding.image_drift import SHIFT, TILT, DriftModel, Estimate, drift_slopes
from lightpage.runtime.model.decoding.page import Inference
from tests.lightpage.uneven import overlapping, uneven
from tests.runtime import toy

NY, NX = toy.PAGE
Y, X = np.meshgrid(np.linspace(-1, 1, NY), np.linspace(-1, 1, NX), indexing="ij")
SLOPES = np.stack([0.5 * np.sign(np.sin(5 * X + 1)) + 0.2 * Y, 0.5 * np.cos(6 * Y) - 0.2 * X, X, Y])
"""Shift turns phases zone by zone, tilt evenly over the page."""
ANYTHING = np.diag([3.0, 3.0, 0.5, 0.5]) ** 2
PILOTS = Pilots.of_profile(toy.PROFILE, 16)


def page(
    drift: tuple[float, ...], levels: int | Levels = 16, kappa: float = 400.0, seed: int = 0, outliers: float = 0.0
) -> tuple[Inference, Pilots]:
    """A page decoded without the drift that its image has, and its pilots."""
    rng = np.random.default_rng(seed)
    symbols = toy.symbols_of(Levels.of(levels).count, seed)[0]
    pilots = Pilots.of_profile(toy.PROFILE, levels)
    phase = symbol_phases(symbols, levels) + np.tensordot(drift, SLOPES[: len(drift)], 1)
    phase = phase + rng.standard_normal(phase.shape) / np.sqrt(kappa) + 0.05
    wrong = (rng.random(phase.shape) < outliers) & ~pilots.mask
    phase[wrong] = rng.uniform(-np.pi, np.pi, np.count_nonzero(wrong))
    return inference(phase, kappa), pilots


def inference(phase: np.ndarray, kappa: float) -> Inference:
    wrapped = np.angle(np.exp(1j * phase)).astype(np.float32)
    flat = np.full(phase.shape, kappa, np.float32)
    return Inference(flat * np.stack([np.cos(wrapped), np.sin(wrapped)]), wrapped, flat)


def estimate(
    drift: tuple[float, ...], levels: int | Levels = 16, prior: np.ndarray = ANYTHING, **noise: float
) -> Estimate:
    seen, pilots = page(drift, levels, **noise)  # type: ignore[arg-type]
    found = DriftModel(SLOPES).estimate(seen, levels, pilots, prior)
    assert found is not None
    return found


@pytest.mark.parametrize("drift", [(-0.8, 0.6), (0.05, 0.1, 0.08, -0.05)])
@pytest.mark.parametrize("levels", [16, 256, uneven(16), overlapping(256)])
def test_the_drift_is_found_within_the_error_that_is_stated(drift: tuple[float, ...], levels: int | Levels) -> None:
    found = estimate(drift, levels)
    truth = np.zeros(4)
    truth[: len(drift)] = drift
    assert np.all(np.abs(found.drift - truth) < 4 * found.deviations)
    assert found.deviations[SHIFT].max() < 0.1
    assert found.deviations[TILT].max() < 0.1


def test_safe_decisions_count_beside_the_pilots_and_unsafe_ones_do_not() -> None:
    few, many = estimate((0.1, 0.1), 256), estimate((0.1, 0.1), 16)
    share = np.sqrt(NY * NX / np.count_nonzero(PILOTS.mask))
    assert np.all(np.abs(few.deviations / many.deviations / share - 1) < 0.6)


def test_a_large_page_shows_its_drift_by_some_of_its_symbols(monkeypatch: pytest.MonkeyPatch) -> None:
    seen, few = page((0.1, -0.05, 0.01, 0.02), kappa=1e9)
    noise = np.random.default_rng(1).normal(0, 0.05, (20 * NY, 20 * NX))
    large = inference(np.tile(seen.phase, (20, 20)) + noise, 400)
    mask = np.pad(few.mask, [(0, 19 * side) for side in toy.PAGE])
    decide, symbols = Levels.nearest_phases, list[int]()
    monkeypatch.setattr(Levels, "nearest_phases", lambda own, mu: symbols.append(mu.size) or decide(own, mu))
    found = DriftModel(np.tile(SLOPES, (1, 20, 20))).estimate(large, 16, Pilots(mask, few.phases), ANYTHING)
    assert found is not None
    assert np.abs(found.drift[SHIFT] - (0.1, -0.05)).max() < 0.01
    assert 5000 < symbols[0] <= len(few.phases) + 10_000 < 0.1 * mask.size


def test_decisions_among_uneven_levels_say_as_much_as_among_even_ones() -> None:
    even, other = estimate((0.1, 0.1), 16), estimate((0.1, 0.1), uneven(16))
    np.testing.assert_allclose(other.deviations, even.deviations, rtol=0.2)
    seen, pilots = page((0.1, 0.1), uneven(16))
    mistaken = DriftModel(SLOPES).estimate(seen, 16, pilots, ANYTHING)
    assert mistaken is not None
    assert other.over_claim < 1.1 < 1.4 < mistaken.over_claim


def test_a_few_wild_symbols_do_not_pull_the_estimate() -> None:
    found = estimate((0.2, -0.1), outliers=0.05)
    assert np.all(np.abs(found.drift[SHIFT] - (0.2, -0.1)) < 0.03)


def test_what_was_known_before_counts_as_far_as_the_page_is_vague() -> None:
    known = np.diag([0.02, 0.02, 1e-3, 1e-3]) ** 2
    vague, clear = estimate((0.1, 0.1), 256, known, kappa=20), estimate((0.1, 0.1), 16, known, kappa=2000)
    assert np.abs(vague.drift[SHIFT]).max() < 0.05
    assert clear.drift[SHIFT].min() > 0.08
    assert np.all(vague.deviations <= np.sqrt(np.diag(known)))


def test_a_pages_own_pilots_take_the_place_of_the_devices() -> None:
    written, usual = page((0.1, -0.05))
    symbols = np.random.default_rng(8).integers(16, size=toy.PAGE).astype(np.uint8)
    turn = symbol_phases(symbols, 16) - symbol_phases(toy.symbols_of(16, 0)[0], 16)
    other = inference(written.phase + turn, 400)
    mask = np.zeros(toy.PAGE, bool)
    mask[::3, ::4] = True
    assert DriftModel(SLOPES).estimate(other, 16, usual, ANYTHING) is None
    found = DriftModel(SLOPES).estimate(other, 16, Pilots.of_symbols(mask, symbols, 16), ANYTHING)
    assert found is not None
    assert np.all(np.abs(found.drift[SHIFT] - (0.1, -0.05)) < 0.03)


def test_frames_that_are_refused_a_little_off_their_place_are_told_as_frames() -> None:
    refused = Mock()
    refused.graph.value.return_value = np.ones((2, 2, 10), np.float32)
    refused.infer.side_effect = FrameError("frame pair", "no light", "light")
    for pair, kind in ((Mock(), FrameError), (None, BundleError)):
        with pytest.raises(kind):
            drift_slopes(refused, Mock(), np.zeros(1), pair)


def test_phases_freed_from_a_drift_show_it_no_more() -> None:
    model, drift = DriftModel(SLOPES), np.array([0.2, -0.1, 0.05, 0.1])
    seen, pilots = page(tuple(drift))
    left = model.estimate(seen.turned(-model.phase_change(drift)), 16, pilots, ANYTHING)
    assert left is not None
    assert np.all(np.abs(left.drift) < 4 * left.deviations)
