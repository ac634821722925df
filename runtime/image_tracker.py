"""Follows the image from page to page, and finds it again where it was lost."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from optics.page import check_levels
from optics.pilots import PilotCheck, Pilots, read_pilots
from optics.recording import FramePair
from optics.registration.image_search import FoundImage
from runtime.bundle import Table
from runtime.decoder import DecodedPage, Decoder, ImagePosition, Inference, Timings
from runtime.drift_tables import BundleTables, DriftTables
from runtime.image_drift import SHIFT, TILT, DriftModel, Estimate
from runtime.image_search import BundleSearch, PageSearch
from runtime.tracking import NoTracker, Tracker, confirmed

Real = NDArray[np.float64]

JUMP_PX = 0.06
"""Shift of a page from which it is decoded again, where noise (0.01 px on a bench page) does not explain it. Phases put
right to first order lose 0.03 bit here, and 0.17 at 0.15 px."""

ATTEMPTS = 4
"""Most decodes of one page: a search, and then corrections to a tenth of what is left each."""

WALK = np.array([0.02, 0.02, 0.001, 0.001])
"""Standard deviation of the drift from one page to the next of a quiet device."""

WALK_MEMORY = 0.2
"""Weight of the last page in what is known of a device's walk: it is learnt within some five pages."""

LARGEST_WALK_PX = 0.3
"""A step beyond this says nothing of the walk."""

WIDEST = np.array([3.0, 3.0, 0.03, 0.03])
"""Standard deviation of a jump, as far as phases can show it."""

SEARCHED_PX = 0.03
"""Correction of a found image's place from which the page is decoded again: half a percent of the AIR is worth it."""

SEARCH_ERROR_PX = 0.15
"""Standard deviation of a found image's place, three times what it is on a bench page's 54 pilots."""

TILT_PER_PX = 0.0007
"""Standard deviation of the tilt that comes with a shift, beside what follows if the reference stays, radians a camera
pixel: a tenth of what the most curved reference in the capture range gives."""

START_TILT = 0.002
"""Standard deviation of the tilt of a device that was not looked at for long, radians."""

RETRACE_RAD = 0.015
"""Tilt from which the table is traced again: branches of one symbol then differ by twice as much, which the network
takes for noise; below, turning the decoded phases costs less than 0.02 bit."""

PLAIN_DEVIATIONS = 4.0
"""A shift of so many standard deviations is there, however large they are: the further off a page is, the less exactly
it says by how much, until it has been decoded where it lies."""

LARGEST_ERROR_PX = 0.15
"""Standard deviation of the estimate, per axis, above which a page is left out unless its shift is plain to see."""

NEARBY_PX = 0.3
"""A search that ends so near to where the page was decoded has found nothing new."""

CONTRADICTED = 0.9
"""Share of what pilots confirmed of an earlier attempt below which a later one, made where that said, is no better."""

FRUITLESS = 0.9
"""Share of what the pilots confirmed when a search found nothing new, below which another one may."""


@dataclass(frozen=True)
class ImageState:
    """What a page is decoded with.

    Attributes:
        drift: estimate since calibration, [4], see `runtime.image_drift`.
        covariance: of the drift of the next page about it, [4, 4].
        decoder: whose table holds `traced_tilt` of it.
        table: tensors that are fed for the page.
        traced_tilt: [2].
        walk: variance of the drift from one page to the next, as the last pages showed it, [4].
        settled: whether the last page was confirmed here. Until then the image is looked for first.
        jump_px: shift since the last page, (x, y), of which it is not known whether the reference has come along.
        fruitless: share that the pilots confirmed when a search last found nothing new here, else 1.
    """

    drift: Real
    covariance: Real
    decoder: Decoder
    table: Table
    traced_tilt: Real
    walk: Real
    settled: bool = False
    jump_px: Real = field(default_factory=lambda: np.zeros(2))
    fruitless: float = 1.0

    @property
    def untraced(self) -> Real:
        """Drift that the table does not hold, [4]."""
        return np.concatenate([np.zeros(2), self.drift[TILT] - self.traced_tilt])


@dataclass(frozen=True)
class _Attempt:
    """One decode of a page.

    Attributes:
        state: what it was decoded with.
        after: what the page shows of the next one.
        inference: its phases freed from all that is known of drift by now.
        check: what its pilots confirm.
        again: whether the image lies far enough from where it was looked at for another decode to pay.
    """

    state: ImageState
    after: ImageState
    inference: Inference
    check: PilotCheck
    again: bool

    @property
    def correction_px(self) -> float:
        """How far from where it was looked at the image is now taken to lie, along the worse axis."""
        return float(np.abs(self.after.drift - self.state.drift)[SHIFT].max())


class ImageTracker:
    """Kalman filter of the image's drift, which walks from page to page, with a search where that is lost.

    Args:
        decoder: of the bundle as it is.
        model: reads drift from decoded phases.
        tables: applies it.
        search: finds an image that was lost, None where the bundle cannot.
        walk: standard deviation of the drift from page to page, [4], to begin with and at least.
    """

    def __init__(
        self,
        decoder: Decoder,
        model: DriftModel,
        tables: DriftTables,
        search: PageSearch | None,
        walk: Real = WALK,
    ) -> None:
        self._decoder, self._model, self._tables, self._search, self._walk = decoder, model, tables, search, walk
        start = np.diag([WALK[0], WALK[1], START_TILT, START_TILT]) ** 2
        self._lock = threading.Lock()
        """Guards the state; never held while anything is computed."""
        self._state = ImageState(np.zeros(4), start, decoder, {}, np.zeros(2), walk**2)

    @property
    def state(self) -> ImageState:
        """What the next page is decoded with."""
        with self._lock:
            return self._state

    def fork(self) -> ImageTracker:
        """See `Tracker`."""
        other = ImageTracker(self._decoder, self._model, self._tables, self._search, self._walk)
        other._state = self.state
        return other

    def refitted(self, decoder: Decoder) -> ImageTracker:
        """See `Tracker`: what drift does to phases is taken to be as before."""
        search = None if self._search is None else BundleSearch(decoder)
        return ImageTracker(decoder, self._model, BundleTables(decoder), search, self._walk)

    def decode(self, pair: FramePair, levels: int, pilots: Pilots | None = None) -> DecodedPage:
        """Decode a page where its image lies.

        The image is looked for before anything is decoded at the start and after a page that was not confirmed, and
        after it where the pilots confirm too little. What is learnt counts for the next page only where this one's
        pilots confirm it: a page that is not this device's moves nothing.
        """
        begun, clock = self.state, _Clock()
        check_levels(levels)
        self._decoder.check(pair)
        pilots = pilots or self._decoder.pilots(levels)
        clock.add("check_s")
        state, found = begun, None
        if not begun.settled and self._search is not None:
            found = self._search.find(pair, pilots, self._around(begun))
            state = self._moved_to(found, begun)
            clock.add("search_s")
        best: _Attempt | None = None
        just_found = found is not None and found.found
        for _ in range(ATTEMPTS):
            inference = state.decoder.infer(pair, state.table)
            clock.add("inference_s")
            attempt = self._read(inference, state, levels, pilots)
            best = attempt if best is None or not _contradicted(attempt, best) else best
            clock.add("decision_s")
            if attempt.again or (just_found and attempt.correction_px > SEARCHED_PX):
                state, just_found = attempt.after, False
                continue
            if found is not None or self._search is None or not _search_may_pay(best):
                break
            found = self._search.find(pair, pilots, self._around(begun))
            state = self._moved_to(found, best.after)
            clock.add("search_s")
            if state is best.after:
                break
            just_found = True
        assert best is not None  # at least one attempt
        page = state.decoder.post_process(best.inference, levels, pilots)
        after = self._learn(begun, best, page.check, found)
        clock.add("decision_s")
        page = replace(page, timings=clock.timings, image=_position(after, found))
        return confirmed(page, found)

    def _read(self, inference: Inference, state: ImageState, levels: int, pilots: Pilots) -> _Attempt:
        """Take in what a decoded page shows of drift beyond what its state knows."""
        known = inference.turned(-self._model.phase_change(state.untraced))
        jump = self._model.estimate(known, levels, pilots, np.diag(WIDEST**2))
        unseen = replace(state, covariance=state.covariance + np.diag(state.walk))
        if jump is None:
            return _Attempt(state, unseen, known, read_pilots(known.p, pilots).check, again=False)
        shift, error = jump.drift[SHIFT], jump.deviations[SHIFT]
        plain = np.linalg.norm(shift / error) > PLAIN_DEVIATIONS
        jumped = bool(plain and np.abs(shift).max() > JUMP_PX)
        if not (plain or error.max() <= LARGEST_ERROR_PX):
            return _Attempt(state, unseen, known, read_pilots(known.p, pilots).check, again=False)
        step = state.jump_px + (shift if jumped else 0)
        prior = _after_jump(state.covariance, shift) if jumped else state.covariance
        # the pilots say whether the reference has come along
        tilts = [np.zeros(2), self._tables.tilt_of(step)] if np.any(step) else [np.zeros(2)]
        read = [self._freed(known, tilt, levels, pilots, prior) for tilt in tilts]
        freed, drift, covariance, check = max(read, key=lambda each: each[3].confirmed_bits)
        walk = self._walked(state, jump)
        settled = replace(state, walk=walk, jump_px=np.zeros(2))
        after = self._state_at(state.drift + drift, covariance + np.diag(walk), settled)
        return _Attempt(state, after, freed, check, again=jumped or after.decoder is not state.decoder)

    def _freed(
        self, known: Inference, tilt: Real, levels: int, pilots: Pilots, prior: Real
    ) -> tuple[Inference, Real, Real, PilotCheck]:
        """A page freed from a tilt and from what drift it shows then; all of that drift, its covariance, the check."""
        guess = np.concatenate([np.zeros(2), tilt])
        tilted = known.turned(-self._model.phase_change(guess)) if tilt.any() else known
        rest = self._model.estimate(tilted, levels, pilots, prior)
        if rest is None:
            return tilted, guess, prior, read_pilots(tilted.p, pilots).check
        freed = tilted.turned(-self._model.phase_change(rest.drift))
        return freed, guess + rest.drift, rest.covariance, read_pilots(freed.p, pilots).check

    def _walked(self, state: ImageState, step: Estimate) -> Real:
        """What is known of the walk after a page that has moved by `step`."""
        quiet, last = self._walk**2, np.maximum(step.drift**2 - np.diag(step.covariance), 0)
        walk = np.maximum(quiet, state.walk + WALK_MEMORY * (last - state.walk))
        walk[TILT] = quiet[TILT]
        return np.asarray(np.minimum(walk, np.maximum(quiet, LARGEST_WALK_PX**2)))

    def _state_at(self, drift: Real, covariance: Real, like: ImageState) -> ImageState:
        """The state of a drift: its shift in the table that is fed, its tilt traced where it is large and certain."""
        away, error = np.abs(drift[TILT] - like.traced_tilt), np.sqrt(np.diag(covariance)[TILT])
        decoder, traced = like.decoder, like.traced_tilt
        if np.any((away > RETRACE_RAD) & (away > PLAIN_DEVIATIONS * error)):
            decoder, traced = self._tables.traced(drift[TILT]), drift[TILT].copy()
        return replace(
            like,
            drift=drift,
            covariance=covariance,
            decoder=decoder,
            table=self._tables.shifted(drift[SHIFT]),
            traced_tilt=traced,
        )

    def _moved_to(self, found: FoundImage, state: ImageState) -> ImageState:
        """The state where the image was found; the same one where that is nothing new."""
        away = found.shift_px - state.drift[SHIFT]
        if not found.found or np.abs(away).max() < NEARBY_PX:
            return state
        tilt = START_TILT + TILT_PER_PX * float(np.linalg.norm(away))
        covariance = np.diag([SEARCH_ERROR_PX, SEARCH_ERROR_PX, tilt, tilt]) ** 2
        moved = replace(state, jump_px=state.jump_px + away)
        return self._state_at(np.concatenate([found.shift_px, state.drift[TILT]]), covariance, moved)

    def _learn(self, begun: ImageState, best: _Attempt, check: PilotCheck, found: FoundImage | None) -> ImageState:
        """Keep what a page showed for the next one, unless another page has been learnt from in the meantime."""
        if not check.confirmed:
            after = replace(begun, settled=False)
        elif check.sound:
            after = replace(best.after, settled=True, fruitless=1.0)
        else:
            share = begun.fruitless if found is None else check.share
            after = replace(best.after, settled=True, fruitless=share)
        with self._lock:
            if self._state is begun:
                self._state = after
        return after if check.confirmed else best.after

    @staticmethod
    def _around(state: ImageState) -> Real:
        """Where to look: where calibration saw the image, and where it was last."""
        last = state.drift[SHIFT]
        return np.stack([np.zeros(2), last]) if np.abs(last).max() > NEARBY_PX else np.zeros((1, 2))


def tracker_for(decoder: Decoder) -> Tracker:
    """The tracker that a bundle's decoder is run with, in service and in evaluation.

    Raises:
        BundleError, CalibrationError: see `DriftModel.of_decoder`.
    """
    if "registration" not in decoder.table_shapes:
        return NoTracker(decoder)
    search = BundleSearch(decoder) if decoder.shows_field else None
    return ImageTracker(decoder, DriftModel.of_decoder(decoder), BundleTables(decoder), search)


def _search_may_pay(best: _Attempt) -> bool:
    """Whether the pilots confirm less than they did when a search last found nothing new."""
    return not best.check.sound and best.check.share < FRUITLESS * best.state.fruitless


def _after_jump(covariance: Real, shift_px: Real) -> Real:
    """Covariance [4, 4] of the drift after a jump: the shift may be anything, and its tilt comes with it."""
    tilt = covariance[TILT, TILT] + np.eye(2) * (TILT_PER_PX * float(np.linalg.norm(shift_px))) ** 2
    return np.block([[np.diag(WIDEST[SHIFT] ** 2), np.zeros((2, 2))], [np.zeros((2, 2)), tilt]])


def _contradicted(attempt: _Attempt, earlier: _Attempt) -> bool:
    """Whether the pilots contradict a later attempt: a chance advantage of the earlier one is none."""
    return attempt.check.confirmed_bits < CONTRADICTED * earlier.check.confirmed_bits


def _position(state: ImageState, found: FoundImage | None) -> ImagePosition:
    x, y, tilt_x, tilt_y = map(float, state.drift)
    return ImagePosition(x, y, tilt_x, tilt_y, found is not None, found is not None and found.found)


class _Clock:
    """Adds up how long the parts of a page take."""

    def __init__(self) -> None:
        self._last = time.perf_counter()
        self.timings = Timings(0.0, 0.0, 0.0)

    def add(self, part: str) -> None:
        """Count the time since the last call as one of `Timings`' parts."""
        now = time.perf_counter()
        self.timings = replace(self.timings, **{part: getattr(self.timings, part) + now - self._last})
        self._last = now
