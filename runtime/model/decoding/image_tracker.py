"""Follows the image from page to page, and finds it again where it was lost."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.image_search import FEWEST_SEARCHED, FoundImage
from lightpage.calibration.sampling_table import SamplingTable
from lightpage.page.levels import Levels
from lightpage.page.pilots import PilotCheck, Pilots, read_pilots
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.bundle.manifest import FIELD
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_drift import SHIFT, TILT, BundleSearch, BundleTables, DriftModel, Estimate
from lightpage.runtime.model.decoding.image_position import ImagePosition
from lightpage.runtime.model.decoding.page import DecodedPage, Inference, StepLimit, Timings, check_residual
from lightpage.runtime.model.decoding.tracking import NoTracker, Tracker, TrackerMemory, confirmed
from lightpage.runtime.model.decoding.turns import Turn, Turns, patiently
from lightpage.runtime.model.execution.estimator_graph import EstimatorGraph
from lightpage.runtime.model.execution.twin import OnnxTwin

Real = NDArray[np.float64]

_log = logging.getLogger(__name__)

JUMP_PX = 0.06
"""Shift of a page from which it is decoded again, where noise (0.01 px on a bench page) does not explain it. Phases put
right to first order lose 0.03 bit here, and 0.17 at 0.15 px."""

CORRECTIONS = 2
"""Times that a page is decoded again where it shows that its image lies, before and after a search: each is good to a
tenth of what is left."""

WALK = np.array([0.02, 0.02, 0.001, 0.001])
"""Standard deviation of the drift from one page to the next of a quiet device."""

WALK_MEMORY = 0.2
"""Weight of the last page in what is known of a device's walk: it is learnt within some five pages."""

LARGEST_WALK_PX = 0.3
"""A step beyond this says nothing of the walk."""

WIDEST = np.array([3.0, 3.0, 0.03, 0.03])
"""Standard deviation of a jump, as far as phases can show it."""

STALE_PX, MOST_STALE_PX = 0.03, 0.05
"""Distance from where an image was looked at, up to which pages behind are read from there, computed before this one
was read: the first, or what is not known of the place, and the second at most. It costs 0.003 bit in bright light;
0.04 px cost 0.006. Of a device that walks as `WALK`, a page is computed 2.8 times, and 2.6 times at 0.04 px."""

MOST_AHEAD, FEWEST_AHEAD = 64, 4
"""Pages that are computed ahead of the one that is read: one more after each page that leaves the place where they are
looked at as it is, and half as many after one that changes it, for which they are computed again."""

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

SIGNIFICANT_DEVIATIONS = 4.0
"""A shift of so many standard deviations is there, however large they are: the further off a page is, the less exactly
it says by how much, until it has been decoded where it lies."""

LARGEST_ERROR_PX = 0.15
"""Standard deviation of the estimate, per axis, above which a page is left out unless its shift is significant."""

NEARBY_PX = 0.3
"""A search that ends so near to where the page was decoded has found nothing new."""

WORSE = 0.9
"""A later attempt at a page replaces an earlier one unless its pilots confirm less than this share of what they did."""

DROP = 0.85
"""A page is searched for where its pilots confirm less than this share of what they lately did, and the device is not
sound. So a device that has changed for good is searched for once."""

SHARE_MEMORY = 0.2
"""Weight of the last page in the share that pilots lately confirmed."""

FEWEST_PILOTS = 12
"""Pilots of a page from which drift is read: four numbers can be fitted to fewer whatever they are."""


_LEARNT = ("drift", "covariance", "walk", "traced_tilt", "jump_px")
"""Arrays of an `ImageState` that another process is told of."""


@dataclass(frozen=True)
class ImageState:
    """The image position and the drift that a page is decoded with.

    Attributes:
        drift: estimate since calibration, [4], see `lightpage.runtime.model.decoding.image_drift`.
        covariance: covariance of the drift of the next page about it, [4, 4].
        decoder: decoder whose table holds `traced_tilt` of it.
        table: tensors that are fed for the page.
        looked_px: shift that is in `table`, [2].
        traced_tilt: [2].
        walk: variance of the drift from one page to the next, as the last pages showed it, [4].
        settled: whether a page was confirmed yet. Until then the image is looked for before anything is decoded.
        jump_px: shift since the last page, (x, y), of which it is not known whether the reference has come along.
        share: share of the claimed information that pilots lately confirmed; 1 before any page.
    """

    drift: Real
    covariance: Real
    decoder: Decoder
    table: SamplingTable
    looked_px: Real
    traced_tilt: Real
    walk: Real
    settled: bool = False
    jump_px: Real = field(default_factory=lambda: np.zeros(2))
    share: float = 1.0

    @property
    def untraced(self) -> Real:
        """Drift that the table does not hold, [4]."""
        return np.asarray(self.drift - np.concatenate([self.looked_px, self.traced_tilt]))


class _Page(NamedTuple):
    """A page as it is to be decoded.

    Attributes:
        pair: frames of the page.
        levels: levels that it is shown at.
        pilots: known symbols of the page.
        limit: limit on the time of the steps of each inference.
    """

    pair: FramePair
    levels: Levels
    pilots: Pilots
    limit: StepLimit | None


@dataclass(frozen=True)
class _Attempt:
    """A decode of a page.

    Attributes:
        state: what it was decoded with.
        after: what it shows of where the image lies.
        inference: its phases freed from all that is known of drift by now.
        check: what its pilots confirm.
        prior: covariance of the drift before the page was read, [4, 4].
        again: whether the image lies far enough from where it was looked at for another decode to pay.
        step: drift as the page alone shows it, None where it does not.
    """

    state: ImageState
    after: ImageState
    inference: Inference
    check: PilotCheck
    prior: Real
    again: bool = False
    step: Estimate | None = None

    @property
    def correction_px(self) -> float:
        """Return how far from where it was looked at the image is now taken to lie, along the worse axis."""
        return float(np.abs(self.after.drift[SHIFT] - self.state.looked_px).max())


class ImageTracker:
    """Kalman filter of the image's drift, which walks from page to page, with a search where that is lost.

    Args:
        decoder: decoder of the bundle as it is.
        model: reads drift from decoded phases.
        tables: applies it.
        search: finds an image that was lost, None where the bundle cannot.
        memory: what another tracker of this device has learnt, None to start anew.
    """

    def __init__(
        self,
        decoder: Decoder,
        model: DriftModel,
        tables: BundleTables,
        search: BundleSearch | None,
        memory: TrackerMemory | None = None,
    ) -> None:
        self._decoder, self._model, self._tables, self._search = decoder, model, tables, search
        start = np.diag([SEARCH_ERROR_PX, SEARCH_ERROR_PX, START_TILT, START_TILT]) ** 2
        self._turns = Turns()
        self._in_batches, self._ahead = decoder.batches.largest > 1, MOST_AHEAD
        self.state = ImageState(np.zeros(4), start, decoder, {}, np.zeros(2), np.zeros(2), WALK**2)
        """What the next page is decoded with."""
        if memory is not None:
            self.state = self._remembered(memory)

    @property
    def image_px(self) -> tuple[float, float]:
        """See `Tracker`."""
        x, y = map(float, self.state.drift[SHIFT])
        return x, y

    def memory(self) -> TrackerMemory:
        """See `Tracker`."""
        state = self.state
        plain = {name: getattr(state, name).tolist() for name in _LEARNT}
        return TrackerMemory.model_validate({**plain, "settled": state.settled, "share": state.share})

    def _remembered(self, memory: TrackerMemory) -> ImageState:
        """The state that another tracker was in."""
        learnt = {name: np.array(getattr(memory, name)) for name in _LEARNT}
        traced = learnt["traced_tilt"]
        return ImageState(
            decoder=self._tables.traced(traced) if traced.any() else self._decoder,
            table=self._tables.shifted(learnt["drift"][SHIFT]),
            looked_px=learnt["drift"][SHIFT],
            settled=memory.settled,
            share=memory.share,
            **learnt,
        )

    def anew(self) -> ImageTracker:
        """See `Tracker`."""
        return ImageTracker(self._decoder, self._model, self._tables, self._search)

    def fork(self) -> ImageTracker:
        """See `Tracker`."""
        other = self.anew()
        other.state = self.state
        return other

    def refitted(self, decoder: Decoder) -> ImageTracker:
        """See `Tracker`: what drift does to phases is taken to be as before."""
        twin = OnnxTwin(decoder.bundle)
        search = None if self._search is None else BundleSearch(decoder, twin)
        return ImageTracker(decoder, self._model, BundleTables(decoder, twin), search)

    def turn(self, waiting: Callable[[], None] = patiently) -> Turn:
        """See `Tracker`."""
        return self._turns.take(waiting)

    def decode(
        self,
        pair: FramePair,
        levels: int,
        pilots: Pilots | None = None,
        turn: Turn | None = None,
        limit: StepLimit | None = None,
    ) -> DecodedPage:
        """Decode a page where its image lies.

        The image is looked for before anything is decoded at the start, and later where the pilots confirm too little.
        What is learnt counts for the next page only where this one's pilots confirm it: a page that is not this
        device's moves nothing. Pages that are decoded at the same time wait for none; where they are computed together,
        they are taken in their order: each begins with what the one before it has taught.
        """
        with self._turns.taken(turn) as turn:
            _ = self._model.slopes  # may still be measured; two inferences at once may not fit the memory
            begun, clock, inference = self.state, _Clock(), None
            shown = self._decoder.bundle.levels(levels)
            if self._in_batches:
                turn.wait(lambda before: before < self._ahead)
                clock.add("turn_s")
            with self._decoder.batches.under_way():
                self._decoder.check(pair)
                asked = _Page(pair, shown, pilots or self._decoder.pilots(levels), limit)
                clock.add("check_s")
                if self._in_batches:
                    begun, inference = self._in_turn(turn, asked, clock)
                best, found, step = self._followed(asked, begun, inference, clock)
                check_residual(best.inference.residual, self._decoder.bundle.manifest)
                learn = partial(self._learn, begun, best, step, searched=found is not None)
                if self._in_batches:  # the page behind waits for it
                    learn()
                    turn.close()
                page = self._decoder.post_process(best.inference, levels, asked.pilots)
                if not self._in_batches:
                    learn()
                clock.add("decision_s")
        page = replace(page, check=best.check, image=_position(best.after, found), timings=clock.timings)
        return confirmed(page, found)

    def _in_turn(self, turn: Turn, page: _Page, clock: _Clock) -> tuple[ImageState, Inference | None]:
        """The state that the page before has left, and what the graph says of a page by it; nothing before any page.

        The graph runs beforehand, and again where a page before it shows that the image is to be looked at elsewhere.
        """
        while True:
            state, inference = self.state, None
            if state.settled:
                inference = _inferred(page, state)
                clock.add_inference(inference)
            else:
                state.decoder.batches.put_off()
            is_next = turn.wait(partial(self._has_left, state))
            clock.add("turn_s")
            if is_next and not self._has_left(state):
                return replace(self.state, table=state.table, looked_px=state.looked_px), inference

    def _has_left(self, state: ImageState, before: int = 0) -> bool:
        """Return whether a page with so many before it, that was decoded with a state, is now to be decoded anew."""
        if before >= self._ahead:
            return False
        now = self.state
        moved = np.any(now.looked_px != state.looked_px)
        return now.settled != state.settled or now.decoder is not state.decoder or bool(moved)

    def _followed(
        self, page: _Page, begun: ImageState, inference: Inference | None, clock: _Clock
    ) -> tuple[_Attempt, FoundImage | None, Estimate | None]:
        """The attempt at a page that counts, the outcome of a search for its image, and what it tells of the walk."""
        state, found = begun, None
        if not begun.settled and self._search is not None and len(page.pilots.phases) >= FEWEST_SEARCHED:
            found = self._search.find(page.pair, page.pilots, self._around(begun))
            state = self._moved_to(found, begun)
            clock.add("search_s")
        best = self._attempts(page, state, found, clock, inference)
        step = best.step if found is None else None
        if found is None and self._search is not None and _search_may_pay(best.check, begun):
            found = self._search.find(page.pair, page.pilots, self._around(begun))
            moved = self._moved_to(found, best.after)
            clock.add("search_s")
            if moved is not best.after:
                there = self._attempts(page, moved, found, clock)
                if not _worse(there, best):
                    best, step = there, None
        return best, found, step

    def _attempts(
        self,
        page: _Page,
        state: ImageState,
        found: FoundImage | None,
        clock: _Clock,
        inference: Inference | None = None,
    ) -> _Attempt:
        """Decode at a place, and again where the page shows that its image lies: the best one, with the first step.

        Args:
            inference: what the graph has said of the page there already.
        """
        enough = SEARCHED_PX if found is not None and found.found else np.inf
        best: _Attempt | None = None
        for _ in range(1 + CORRECTIONS):
            if inference is None:
                inference = _inferred(page, state)
                clock.add_inference(inference)
            attempt = self._read(inference, state, page.levels, page.pilots)
            clock.add("decision_s")
            if best is not None and _worse(attempt, best):
                break
            best = attempt if best is None else replace(attempt, step=best.step)
            if not attempt.again and attempt.correction_px <= enough:
                break
            # the same page once more: what it has taught already is no knowledge from before it
            after = attempt.after
            looking = after if np.array_equal(after.drift[SHIFT], after.looked_px) else self._looking_there(after)
            state = replace(looking, covariance=attempt.prior)
            inference, enough = None, np.inf
        assert best is not None  # at least one attempt
        return best

    def _read(self, inference: Inference, state: ImageState, levels: Levels, pilots: Pilots) -> _Attempt:
        """Take in what a decoded page shows of drift beyond what its state knows."""
        known, measured = self._model.unexplained(inference, state.untraced)
        many = len(pilots.phases) >= FEWEST_PILOTS
        step = self._model.estimate(known, levels, pilots, np.diag(WIDEST**2)) if many else None
        unread = _Attempt(state, state, known, read_pilots(known.p, pilots).check, state.covariance)
        if step is None:
            return unread
        step = replace(step, drift=step.drift + measured)
        shift, error = step.drift[SHIFT], step.deviations[SHIFT]
        significant = bool(np.linalg.norm(shift / error) > SIGNIFICANT_DEVIATIONS)
        if not (significant or error.max() <= LARGEST_ERROR_PX):
            return unread
        jumped = significant and bool(np.abs(shift).max() > JUMP_PX)
        prior = _after_jump(state.covariance, shift) if jumped else state.covariance
        # after a jump the pilots say whether the reference has come along
        jump = state.jump_px + (shift if jumped else 0)
        tilts = [np.zeros(2)]
        if np.any(jump) and inference.drift is None:
            tilts.append(self._tables.tilt_of(jump))
        read = [self._freed(known, tilt, levels, pilots, prior) for tilt in tilts]
        freed, drift, covariance, check = max(read, key=lambda each: each[3].confirmed_bits)
        drift = state.drift + measured + drift
        after = self._state_at(drift, covariance, replace(state, jump_px=np.zeros(2)))
        elsewhere = not self._in_batches or after.table is not state.table
        again = after.decoder is not state.decoder or (jumped and elsewhere)
        return _Attempt(state, after, freed, check, prior, again, step)

    def _freed(
        self, known: Inference, tilt: Real, levels: Levels, pilots: Pilots, prior: Real
    ) -> tuple[Inference, Real, Real, PilotCheck]:
        """A page freed from a tilt and from what drift it shows then; all of that drift, its covariance, the check."""
        guess = np.concatenate([np.zeros(2), tilt])
        tilted = known.turned(-self._model.phase_change(guess)) if tilt.any() else known
        rest = self._model.estimate(tilted, levels, pilots, prior)
        if rest is None:
            return tilted, guess, prior, read_pilots(tilted.p, pilots).check
        freed = tilted.turned(-self._model.phase_change(rest.drift))
        check = read_pilots(freed.p, pilots, rest.gained_nats(prior)).check
        return freed, guess + rest.drift, rest.covariance, check

    def _state_at(self, drift: Real, covariance: Real, like: ImageState) -> ImageState:
        """The state of a drift: its shift in the table that is fed, its tilt traced where it is large and certain."""
        away, error = np.abs(drift[TILT] - like.traced_tilt), np.sqrt(np.diag(covariance)[TILT])
        decoder, traced = like.decoder, like.traced_tilt
        if np.any((away > RETRACE_RAD) & (away > SIGNIFICANT_DEVIATIONS * error)):
            decoder, traced = self._tables.traced(drift[TILT]), drift[TILT].copy()
        state = replace(like, drift=drift, covariance=covariance, decoder=decoder, traced_tilt=traced)
        at_most = min(max(STALE_PX, float(np.sqrt(np.diag(covariance)[SHIFT]).max())), MOST_STALE_PX)
        stays = self._in_batches and np.abs(drift[SHIFT] - like.looked_px).max() <= at_most
        return state if stays else self._looking_there(state)

    def _looking_there(self, state: ImageState) -> ImageState:
        """The state with the shift that it knows in its table."""
        shift = state.drift[SHIFT].copy()
        return replace(state, table=self._tables.shifted(shift), looked_px=shift)

    def _moved_to(self, found: FoundImage, state: ImageState) -> ImageState:
        """The state where the image was found; the same one where that is nothing new."""
        away = found.shift_px - state.drift[SHIFT]
        if not found.found or np.abs(away).max() < NEARBY_PX:
            return state
        tilt = START_TILT + TILT_PER_PX * float(np.linalg.norm(away))
        covariance = np.diag([SEARCH_ERROR_PX, SEARCH_ERROR_PX, tilt, tilt]) ** 2
        moved = replace(state, jump_px=state.jump_px + away)
        return self._state_at(np.concatenate([found.shift_px, state.drift[TILT]]), covariance, moved)

    def _learn(self, begun: ImageState, best: _Attempt, step: Estimate | None, *, searched: bool) -> None:
        """Keep what a page showed for the next one; of pages that waited for none, the first of those that began alike.

        Args:
            begun: what the page began with.
            best: the attempt that counts.
            step: drift from where the image was expected, None where that says nothing of the walk.
            searched: whether the image was looked for.
        """
        after = begun
        if best.check.confirmed:
            walk = begun.walk if step is None else _walked(begun.walk, step)
            share = min(1.0, best.check.share)
            lately = share if searched else begun.share + SHARE_MEMORY * (share - begun.share)
            after = replace(best.after, settled=True, walk=walk, share=lately)
        stays = after.decoder is begun.decoder and after.table is begun.table
        after = replace(after, covariance=after.covariance + np.diag(after.walk))
        with self._turns.changed:
            if self._in_batches:
                self._ahead = min(self._ahead + 1, MOST_AHEAD) if stays else max(self._ahead // 2, FEWEST_AHEAD)
            elif self.state is not begun:
                return
            self.state = after
            self._turns.changed.notify_all()

    @staticmethod
    def _around(state: ImageState) -> Real:
        """Return where to look: where calibration saw the image, and where it was last."""
        last = state.drift[SHIFT]
        return np.stack([np.zeros(2), last]) if np.abs(last).max() > NEARBY_PX else np.zeros((1, 2))


def tracker_for(decoder: Decoder, memory: TrackerMemory | None = None) -> Tracker:
    """The tracker that a bundle's decoder is run with, in service and in evaluation.

    Args:
        decoder: decoder of the bundle.
        memory: what another tracker of the same bundle has learnt, None to start anew.

    Raises:
        BundleError, CalibrationError: see `DriftModel.of_decoder`.
    """
    if "registration" not in decoder.graph.ports:
        return NoTracker(decoder)
    twin, search = OnnxTwin(decoder.bundle), None
    if FIELD in decoder.bundle.files:
        search = BundleSearch(decoder, twin)
    else:
        _log.warning("%s: no field graph, so an image that is lost is not looked for", decoder.bundle.subject)
    return ImageTracker(decoder, DriftModel.of_decoder(decoder, twin), BundleTables(decoder, twin), search, memory)


def _inferred(page: _Page, state: ImageState) -> Inference:
    """Return what the graph says of a page. An estimator's residual is judged later, where the image is found."""
    doubtful = isinstance(state.decoder.graph, EstimatorGraph)
    return state.decoder.infer(page.pair, state.table, page.pilots, doubtful=doubtful, limit=page.limit)


def _search_may_pay(check: PilotCheck, begun: ImageState) -> bool:
    """Return whether the pilots disagree, or confirm much less than they lately did, and are not only too few."""
    return not check.agrees or (not check.sound and check.share < DROP * begun.share)


def _walked(walk: Real, step: Estimate) -> Real:
    """Return what is known of the walk, variances [4], after a page that has moved by `step`."""
    quiet, last = WALK**2, np.maximum(step.drift**2 - np.diag(step.covariance), 0)
    slow = np.abs(step.drift) <= LARGEST_WALK_PX
    slow[TILT] = False  # a page shows too little of it
    return np.asarray(np.where(slow, np.maximum(quiet, walk + WALK_MEMORY * (last - walk)), walk))


def _after_jump(covariance: Real, shift_px: Real) -> Real:
    """Covariance [4, 4] of the drift after a jump: the shift may be anything, and its tilt comes with it."""
    tilt = covariance[TILT, TILT] + np.eye(2) * (TILT_PER_PX * float(np.linalg.norm(shift_px))) ** 2
    return np.block([[np.diag(WIDEST[SHIFT] ** 2), np.zeros((2, 2))], [np.zeros((2, 2)), tilt]])


def _worse(attempt: _Attempt, earlier: _Attempt) -> bool:
    return attempt.check.confirmed_bits < WORSE * earlier.check.confirmed_bits


def _position(state: ImageState, found: FoundImage | None) -> ImagePosition:
    x, y, tilt_x, tilt_y = map(float, state.drift)
    return ImagePosition(x, y, tilt_x, tilt_y, found is not None, found is not None and found.found)


class _Clock:
    """Adds up how long the parts of a page take."""

    def __init__(self) -> None:
        self._last = time.perf_counter()
        self.timings = Timings(0.0, 0.0, 0.0)

    def add_inference(self, inference: Inference) -> None:
        """Count the time since the last call as an inference, without what the page waited in it, and its steps."""
        self.add("inference_s", inference.waited_s)
        self.timings = self.timings.with_steps(inference)

    def add(self, part: str, waited_s: float = 0.0) -> None:
        """Count the time since the last call as one of `Timings`' parts, but what was waited of it."""
        now, told = time.perf_counter(), self.timings
        waited = replace(told, waiting_s=told.waiting_s + waited_s)
        self.timings = replace(waited, **{part: getattr(waited, part) + now - self._last - waited_s})
        self._last = now
