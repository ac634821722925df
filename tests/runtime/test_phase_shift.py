"""The image's shift shows in the phases of pilots and safe decisions; pages that say nothing are left out."""

from __future__ import annotations

import numpy as np
import pytest

from optics.page import symbol_phases
from optics.pilots import Pilots
from runtime.decoder import DecodedPage, Timings
from runtime.phase_shift import LARGEST_ERROR_PX, PhaseShift
from tests.runtime import toy

NY, NX = toy.PAGE
Y, X = np.meshgrid(np.linspace(-1, 1, NY), np.linspace(-1, 1, NX), indexing="ij")
SENSITIVITY = np.stack([0.5 * np.sign(X) + 0.2 * Y, 0.4 * np.cos(3 * Y) - 0.3 * X])
REGISTRATION = np.zeros((2, 2, 10), np.float32)


def reader() -> PhaseShift:
    return PhaseShift(REGISTRATION, SENSITIVITY, lambda levels: Pilots.of_profile(toy.PROFILE, levels))


def page(
    shift: tuple[float, float], levels: int = 16, kappa: float = 400.0, seed: int = 0, outliers: float = 0.0
) -> DecodedPage:
    """A page decoded without the shift that its image has, as the sensitivity has it."""
    rng = np.random.default_rng(seed)
    symbols = toy.symbols_of(levels, seed)[0]
    phase = symbol_phases(symbols, levels) - np.tensordot(shift, SENSITIVITY, 1)
    phase = phase + rng.standard_normal(phase.shape) / np.sqrt(kappa) + 0.05
    wrong = rng.random(phase.shape) < outliers
    phase[wrong] = rng.uniform(-np.pi, np.pi, np.count_nonzero(wrong))
    flat = np.full(phase.shape, kappa, np.float32)
    wrapped = np.angle(np.exp(1j * phase)).astype(np.float32)
    return DecodedPage(symbols, flat, flat, wrapped, levels, 0.0, 1.0, 1.0, Timings(0, 0, 0))


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.1, -0.05), (-0.8, 0.6)])
@pytest.mark.parametrize("levels", [16, 256])
def test_the_shift_is_found_within_the_error_that_is_stated(shift: tuple[float, float], levels: int) -> None:
    estimate = reader().estimate(page(shift, levels))
    assert estimate is not None
    assert np.all(np.abs(estimate.shift_px - shift) < 4 * estimate.error_px)
    assert estimate.error_px.max() < 0.06


def test_safe_decisions_count_beside_the_pilots_and_unsafe_ones_do_not() -> None:
    few, many = reader().estimate(page((0.1, 0.1), 256)), reader().estimate(page((0.1, 0.1), 16))
    assert few is not None
    assert many is not None
    ratio = few.error_px / many.error_px
    share = np.sqrt(NY * NX / np.count_nonzero(Pilots.of_profile(toy.PROFILE, 16).mask))
    assert np.all(np.abs(ratio / share - 1) < 0.5)


def test_a_few_wild_symbols_do_not_pull_the_estimate() -> None:
    estimate = reader().estimate(page((0.2, -0.1), outliers=0.05))
    assert estimate is not None
    assert np.all(np.abs(estimate.shift_px - (0.2, -0.1)) < 0.03)


def test_pilots_that_are_not_this_pages_say_nothing() -> None:
    written = page((0.0, 0.0))
    turned = (written.phase + np.random.default_rng(3).uniform(-np.pi, np.pi, toy.PAGE)).astype(np.float32)
    lost = DecodedPage(**{**written.__dict__, "phase": turned})
    assert reader().estimate(lost) is None
    assert reader().measure(lost) is None


def test_a_pages_own_pilots_take_the_place_of_the_devices() -> None:
    written = page((0.1, -0.05))
    symbols = np.random.default_rng(8).integers(16, size=toy.PAGE).astype(np.uint8)
    turn = symbol_phases(symbols, 16) - symbol_phases(written.symbols, 16)
    foreign = DecodedPage(**{**written.__dict__, "phase": np.angle(np.exp(1j * (written.phase + turn)))})
    mask = np.zeros(toy.PAGE, bool)
    mask[::3, ::4] = True
    assert reader().measure(foreign) is None
    found = reader().measure(foreign, Pilots.of_symbols(mask, symbols, 16))
    assert found is not None
    assert np.all(np.abs(found.shift_px - (0.1, -0.05)) < 0.03)


def test_a_page_too_noisy_to_tell_is_left_out() -> None:
    noisy = page((0.0, 0.0), levels=256, kappa=8.0)
    estimate = reader().estimate(noisy)
    assert estimate is not None
    assert estimate.error_px.max() > 0.15
    assert reader().measure(noisy) is None


def test_a_shift_that_is_plain_to_see_is_told_however_roughly() -> None:
    far = page((-0.9, 0.9), levels=256, kappa=14)
    estimate = reader().estimate(far)
    assert estimate is not None
    assert estimate.error_px.max() > LARGEST_ERROR_PX
    assert reader().measure(far) is not None
    near = page((-0.1, 0.1), levels=256, kappa=14)
    assert reader().measure(near) is None


def test_both_cameras_are_looked_at_where_the_image_has_moved_to() -> None:
    assert reader().move(np.zeros(2)) == {}
    moved = reader().move(np.array([1.0, -0.5]))["registration"]
    assert moved.dtype == np.float32
    np.testing.assert_array_equal(moved[:, :, 0], [[1.0, -0.5]] * 2)
    assert not moved[:, :, 1:].any()
