"""The pilots give the piston and how far to believe, and the tracker a slow shift."""

from __future__ import annotations

import numpy as np
import pytest

from optics.errors import PageError
from optics.pilots import Pilots, estimate_piston, estimate_trust, remove_piston, without_spoilt
from runtime.bundle import Table
from runtime.decoder import DecodedPage, Decoder
from runtime.tracking import Lesson, Measured, NoTracker, Shift, ShiftTracker, decode_tracked
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
    """A camera whose image has moved; the measured remainder is the truth less what the table of the page held."""

    def __init__(self, x: float, y: float, error_px: float = 1e-6) -> None:
        self.truth, self.error = Shift(x, y), error_px
        self.silent = False
        self.pilots: Pilots | None = None
        self.page: DecodedPage | None = None
        self.held = Shift()
        """What the table of the page at hand holds."""

    def measure(self, page: DecodedPage, pilots: Pilots | None) -> Measured | None:
        self.pilots = pilots
        rest = Shift(self.truth.x_px - self.held.x_px, self.truth.y_px - self.held.y_px)
        return None if self.silent else Measured(rest, (self.error, self.error))

    def move(self, shift: Shift) -> Table:
        return {"shift": np.array([shift.x_px, shift.y_px])}

    def bend(self, shift: Shift) -> np.ndarray:
        return np.full(toy.PAGE, shift.x_px)

    def show(self, tracker: ShiftTracker, page: DecodedPage, table: Table) -> Lesson:
        """Let the tracker learn from a page that was decoded with this table."""
        self.held = Shift(*table.get("shift", np.zeros(2)))
        return tracker.update(page, table)


@pytest.fixture
def seen(decoder: Decoder) -> DecodedPage:
    return decoder.decode(toy.ToyDevice().page(toy.symbols_of(16, 1)[0], 16), 16)


def test_the_tracker_settles_on_the_shift_and_stops_at_its_limit(seen: DecodedPage) -> None:
    image = ShiftedImage(1.5, -40.0)
    tracker = ShiftTracker(image, limit_px=3)
    for _ in range(20):
        image.show(tracker, seen, tracker.table())
    assert tracker.shift.x_px == pytest.approx(1.5, abs=1e-3)
    assert tracker.shift.y_px == -3
    assert tracker.table()["shift"][0] == tracker.shift.x_px


def test_the_tracker_ignores_silent_pages_and_late_answers(seen: DecodedPage) -> None:
    image = ShiftedImage(1.0, 0.0)
    tracker = ShiftTracker(image)
    old = tracker.table()
    assert image.show(tracker, seen, old) == Lesson(Shift(1.0, 0.0), again=True)
    assert tracker.shift == Shift(1.0, 0.0)
    # decoded before the step above: its remainder is already taken in, but the page itself is worth another decode
    assert image.show(tracker, seen, old).again
    assert tracker.shift == Shift(1.0, 0.0)
    assert not image.show(tracker, seen, tracker.table()).again
    image.silent = True
    assert image.show(tracker, seen, tracker.table()) == Lesson()
    assert tracker.shift == Shift(1.0, 0.0)
    assert NoTracker().update(seen, {}) == Lesson()


def test_the_tracker_believes_a_page_as_far_as_its_error_allows(seen: DecodedPage) -> None:
    walk, error = 0.02, 0.03
    image = ShiftedImage(0.05, -0.05, error)
    tracker = ShiftTracker(image, walk)
    first = image.show(tracker, seen, tracker.table())
    assert first.rest.x_px == pytest.approx(0.05 * walk**2 / (walk**2 + error**2))
    assert not first.again
    # the steady state of a random walk under noise: P = (walk^2 + sqrt(walk^4 + 4 walk^2 error^2)) / 2
    for _ in range(30):
        last = image.show(tracker, seen, tracker.table())
    variance = (walk**2 + np.sqrt(walk**4 + 4 * walk**2 * error**2)) / 2
    rest = 0.05 - (tracker.shift.x_px - last.rest.x_px)
    assert last.rest.x_px / rest == pytest.approx(variance / (variance + error**2), rel=1e-6)
    # what was not seen for long may be anywhere
    image.silent = True
    for _ in range(200):
        image.show(tracker, seen, tracker.table())
    image.silent, image.truth = False, Shift(0.0, 0.0)
    assert image.show(tracker, seen, tracker.table()).rest.x_px == pytest.approx(-0.05, rel=0.02)


def test_the_tracker_measures_a_page_by_the_pilots_that_came_with_it(decoder: Decoder) -> None:
    symbols = np.random.default_rng(4).integers(16, size=toy.PAGE).astype(np.uint8)
    mask = np.zeros(toy.PAGE, bool)
    mask[::3, ::4] = True
    own = Pilots.of_symbols(mask, symbols, 16)
    image = ShiftedImage(0.0, 0.0)
    decode_tracked(decoder, ShiftTracker(image), toy.ToyDevice().page(symbols, 16), 16, own)
    assert image.pilots is own


def test_a_page_is_freed_from_the_shift_that_it_shows_itself(decoder: Decoder) -> None:
    """The decoder of the toy knows no shift: what the tracker says of the page can only come in afterwards."""

    class Bent(ShiftedImage):
        def bend(self, shift: Shift) -> np.ndarray:
            return -shift.x_px * slope

    symbols = toy.symbols_of(16, 3)[0]
    slope = np.broadcast_to(np.linspace(-12, 12, toy.PAGE[1]), toy.PAGE)
    pair = toy.ToyDevice().page(symbols, 16)
    plain = decoder.decode(pair, 16)
    page = decode_tracked(decoder, ShiftTracker(Bent(0.05, 0.0)), pair, 16)
    moved = np.angle(np.exp(1j * (page.phase - plain.phase + page.piston_rad - plain.piston_rad)))
    np.testing.assert_allclose(moved, -0.05 * slope, atol=1e-3)
    np.testing.assert_array_equal(page.symbols, np.rint(page.phase * 16 / (2 * np.pi)) % 16)
    assert page.pilot_trust < plain.pilot_trust  # the toy's pilots were right as they were


class TestTrust:
    LEVELS = 16

    @staticmethod
    def noisy(kappa: float, claim: float, seed: int) -> tuple[np.ndarray, Pilots]:
        """p of a page whose errors have concentration `kappa` where `claim` is claimed."""
        rng = np.random.default_rng(seed)
        symbols = toy.symbols_of(16, seed)[0]
        mask = np.zeros(toy.PAGE, bool)
        mask.flat[rng.choice(mask.size, 54, replace=False)] = True
        phase = 2 * np.pi / 16 * symbols + rng.vonmises(0, kappa, toy.PAGE)
        return claim * np.stack([np.cos(phase), np.sin(phase)]), Pilots.of_symbols(mask, symbols, 16)

    @pytest.mark.parametrize(("kappa", "claim"), [(400, 400), (400, 4000), (40, 400), (4, 400)])
    def test_it_takes_an_over_claim_back(self, kappa: float, claim: float) -> None:
        found = []
        for seed in range(40):
            p, pilots = self.noisy(kappa, claim, seed)
            found.append(estimate_trust(p, pilots, estimate_piston(p, pilots).angle_rad))
        # n pilots show n - 1 times the over-claim; the credit of 20 more pulls that towards one
        over = 1 if claim == kappa else claim / (kappa - 0.5 if kappa > 4 else kappa * 0.86)
        expected = min(1, 73 / (20 + 53 * over))
        assert np.median(found) == pytest.approx(expected, rel=0.1)
        assert max(found) <= 1

    def test_pilots_that_are_better_than_claimed_change_nothing(self) -> None:
        p, pilots = self.noisy(4000, 40, 0)
        assert estimate_trust(p, pilots, estimate_piston(p, pilots).angle_rad) == 1

    def test_wrong_pilots_leave_no_belief(self) -> None:
        p, pilots = self.noisy(400, 400, 0)
        wrong = Pilots(pilots.mask, np.roll(pilots.phases, 1))
        assert estimate_trust(p, wrong, estimate_piston(p, wrong).angle_rad) < 0.01

    @pytest.mark.parametrize("kappa", [100, 1000, 4000])
    @pytest.mark.parametrize("spoilt", [1, 2])
    @pytest.mark.parametrize("off_rad", [1.5, 2.0, np.pi])
    def test_few_dead_places_cost_nothing(self, kappa: float, spoilt: int, off_rad: float) -> None:
        p, pilots = self.noisy(kappa, kappa, 0)
        phases = pilots.phases.copy()
        phases[:spoilt] += off_rad
        broken = Pilots(pilots.mask, phases)
        left = without_spoilt(p, broken)
        assert len(left.phases) == 54 - spoilt
        whole, piston = estimate_piston(p, pilots), estimate_piston(p, left)
        assert piston.angle_rad == pytest.approx(whole.angle_rad, abs=0.2 / np.sqrt(kappa))
        before = estimate_trust(p, pilots, whole.angle_rad)
        assert estimate_trust(p, left, piston.angle_rad) == pytest.approx(before, abs=0.05)

    @pytest.mark.parametrize(("kappa", "claim"), [(400, 400), (400, 4000), (40, 400), (4, 400)])
    def test_pilots_of_a_sound_page_all_count(self, kappa: float, claim: float) -> None:
        kept = [len(without_spoilt(*self.noisy(kappa, claim, seed)).phases) for seed in range(40)]
        assert np.mean(kept) > 53.9

    def test_a_device_that_changed_in_part_is_not_excused(self) -> None:
        p, pilots = self.noisy(400, 400, 0)
        phases = pilots.phases.copy()
        phases[:10] += 2.0
        changed = Pilots(pilots.mask, phases)
        assert without_spoilt(p, changed) is changed
        left = without_spoilt(p, Pilots(pilots.mask, np.roll(pilots.phases, 1)))
        assert estimate_trust(p, left, estimate_piston(p, left).angle_rad) < 0.01
