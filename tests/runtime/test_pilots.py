"""The pilots give the piston, and the tracker a slow shift."""

from __future__ import annotations

import numpy as np
import pytest

from optics.errors import PageError
from optics.pilots import Pilots, estimate_piston, remove_piston
from optics.recording import FramePair
from runtime.bundle import Table
from runtime.decoder import DecodedPage, Decoder
from runtime.tracking import NoTracker, Shift, ShiftTracker, decode_tracked
from tests.runtime import toy


def page_of(symbols: np.ndarray, levels: int, piston: float, kappa: float = 5.0) -> np.ndarray:
    phase = symbols * 2 * np.pi / levels + piston
    return kappa * np.stack([np.cos(phase), np.sin(phase)])


def test_piston_is_exact_without_noise() -> None:
    symbols = toy.symbols_of(8, 3)[0]
    piston = estimate_piston(page_of(symbols, 8, 1.234), Pilots.of_profile(toy.PROFILE, 8))
    assert piston.angle_rad == pytest.approx(1.234, abs=1e-12)
    assert piston.coherence == pytest.approx(1)


def test_pilots_that_say_nothing_show_in_the_coherence() -> None:
    rng = np.random.default_rng(1)
    pilots = Pilots.of_profile(toy.PROFILE, 8)
    p = page_of(rng.integers(8, size=toy.PAGE), 8, 0.3)
    count = np.count_nonzero(pilots.mask)
    assert estimate_piston(p, pilots).coherence < 3 / np.sqrt(count)
    assert estimate_piston(np.zeros((2, *toy.PAGE)), pilots).coherence == 0


def test_a_pilot_without_confidence_does_not_count() -> None:
    symbols = toy.symbols_of(8, 3)[0]
    pilots = Pilots.of_profile(toy.PROFILE, 8)
    p = page_of(symbols, 8, 0.5)
    wrong = np.argwhere(pilots.mask)[0]
    p[:, wrong[0], wrong[1]] = [1e-9, -1e-9]
    assert estimate_piston(p, pilots).angle_rad == pytest.approx(0.5, abs=1e-9)


def test_phase_stays_within_half_a_turn() -> None:
    phase = np.linspace(-np.pi, np.pi, 101, dtype=np.float32)
    for angle in (-3.0, 0.0, 3.0):
        turned = remove_piston(phase, angle)
        assert turned.dtype == np.float32
        assert np.abs(turned).max() <= np.float32(np.pi)
        np.testing.assert_allclose(np.exp(1j * turned), np.exp(1j * (phase - angle)), atol=1e-6)


def test_pilots_of_another_page_shape_are_refused() -> None:
    with pytest.raises(PageError, match="pilot positions"):
        estimate_piston(np.zeros((2, 3, 3)), Pilots.of_profile(toy.PROFILE, 8))
    with pytest.raises(PageError, match="pilot positions"):
        Pilots.of_symbols(np.ones((3, 3), bool), np.zeros(toy.PAGE, np.uint8), 8)
    with pytest.raises(PageError, match="pilots"):
        Pilots.of_symbols(np.zeros(toy.PAGE, bool), np.zeros(toy.PAGE, np.uint8), 8)


class ShiftedImage:
    """A camera whose image has moved; the measured remainder is the truth less what the table holds."""

    def __init__(self, x: float, y: float) -> None:
        self.truth = Shift(x, y)
        self.silent = False
        self.pilots: Pilots | None = None

    def measure(self, pair: FramePair, page: DecodedPage, table: Table, pilots: Pilots | None) -> Shift | None:
        self.pilots = pilots
        held = table.get("shift", np.zeros(2))
        return None if self.silent else Shift(self.truth.x_px - held[0], self.truth.y_px - held[1])

    def move(self, shift: Shift) -> Table:
        return {"shift": np.array([shift.x_px, shift.y_px])}


@pytest.fixture
def seen(decoder: Decoder) -> tuple[FramePair, DecodedPage]:
    pair = toy.ToyDevice().page(toy.symbols_of(16, 1)[0], 16)
    return pair, decoder.decode(pair, 16)


def test_the_tracker_settles_on_the_shift_and_stops_at_its_limit(seen: tuple[FramePair, DecodedPage]) -> None:
    image = ShiftedImage(1.5, -40.0)
    tracker = ShiftTracker(image.measure, image.move, gain=0.5, limit_px=3)
    for _ in range(20):
        tracker.update(*seen, tracker.table())
    assert tracker.shift.x_px == pytest.approx(1.5, abs=1e-3)
    assert tracker.shift.y_px == -3
    assert tracker.table()["shift"][0] == tracker.shift.x_px


def test_the_tracker_ignores_silent_pages_and_late_answers(seen: tuple[FramePair, DecodedPage]) -> None:
    image = ShiftedImage(1.0, 0.0)
    tracker = ShiftTracker(image.measure, image.move, gain=1.0)
    old = tracker.table()
    tracker.update(*seen, old)
    assert tracker.shift == Shift(1.0, 0.0)
    # decoded before the step above: its remainder is already taken in, but the page itself is worth another decode
    assert tracker.update(*seen, old)
    assert tracker.shift == Shift(1.0, 0.0)
    assert not tracker.update(*seen, tracker.table())
    image.silent = True
    tracker.update(*seen, tracker.table())
    assert tracker.shift == Shift(1.0, 0.0)
    assert not NoTracker().update(*seen, {})


def test_the_tracker_measures_a_page_by_the_pilots_that_came_with_it(decoder: Decoder) -> None:
    symbols = np.random.default_rng(4).integers(16, size=toy.PAGE).astype(np.uint8)
    mask = np.zeros(toy.PAGE, bool)
    mask[::3, ::4] = True
    own = Pilots.of_symbols(mask, symbols, 16)
    image = ShiftedImage(0.0, 0.0)
    decode_tracked(decoder, ShiftTracker(image.measure, image.move), toy.ToyDevice().page(symbols, 16), 16, own)
    assert image.pilots is own
