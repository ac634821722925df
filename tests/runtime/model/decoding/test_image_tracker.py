"""The tracker follows the image, finds it again, and gives out no page that its pilots do not confirm."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from lightpage.calibration.image_search import REACH_PX, FoundImage
from lightpage.calibration.sampling_table import SamplingTable
from lightpage.errors import CallerLeft, FrameError, Reason, UnconfirmedPageError
from lightpage.page.pilots import PilotCheck, Pilots
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.decoding.batches import OneByOne
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_drift import SHIFT, TILT, DriftModel, Estimate
from lightpage.runtime.model.decoding.image_tracker import CORRECTIONS, RETRACE_RAD, WALK, ImageState, ImageTracker
from lightpage.runtime.model.decoding.page import Inference, StepLimit
from lightpage.runtime.model.decoding.tracking import TrackerMemory
from tests.runtime import toy
from tests.runtime.model.decoding.test_image_drift import SLOPES
from tests.waiting import eventually

Real = np.ndarray


@dataclass
class FakeDevice:
    """A device whose image has drifted, as every part of the tracker sees it.

    What a page shows is the truth less what its table holds; further than `seen_px` off it is noise.
    """

    decoder: Decoder
    drift: Real = field(default_factory=lambda: np.zeros(4))
    error: float = 1e-6
    seen_px: float = 3.0
    reach_px: float = REACH_PX
    searches: list[Real] = field(default_factory=list)
    decodes: list[Real] = field(default_factory=list)
    traces: list[Real] = field(default_factory=list)
    pilots: list[Pilots] = field(default_factory=list)
    held: Real = field(default_factory=lambda: np.zeros(4))
    together: int = 1

    def tracker(self, search: bool = True, memory: TrackerMemory | None = None) -> ImageTracker:
        return ImageTracker(
            FakeDecoder(self, np.zeros(2)),  # type: ignore[arg-type]
            FakeModel(self),
            FakeTables(self),
            FakeSearch(self) if search else None,
            memory,
        )

    def page(self, seed: int = 1) -> FramePair:
        return toy.ToyDevice(seed=seed).page(toy.symbols_of(16, seed)[0], 16)


class FakeDecoder:
    """The toy's decoder; what it decodes far from the image is noise."""

    def __init__(self, device: FakeDevice, tilt: Real) -> None:
        self._device, self._tilt, self._decoder = device, tilt, device.decoder
        self.batches = OneByOne()
        self.batches.largest = device.together

    def __getattr__(self, name: str) -> object:
        return getattr(self._decoder, name)

    def infer(
        self,
        pair: FramePair,
        table: SamplingTable | None = None,
        pilots: Pilots | None = None,
        *,
        doubtful: bool = False,
        limit: StepLimit | None = None,
    ) -> Inference:
        device = self._device
        shift = (table or {}).get("shift", np.zeros(2))
        device.held = np.concatenate([np.asarray(shift, np.float64), self._tilt])
        device.decodes.append(device.held)
        inference = self._decoder.infer(pair)
        if np.abs((device.drift - device.held)[SHIFT]).max() < device.seen_px:
            return inference
        return inference.turned(np.random.default_rng(3).uniform(-np.pi, np.pi, toy.PAGE))


class FakeModel(DriftModel):
    def __init__(self, device: FakeDevice) -> None:
        super().__init__(np.zeros((4, *toy.PAGE)))
        self._device, self._known = device, np.zeros(4)

    def phase_change(self, drift: Real) -> Real:
        self._known = drift
        return np.zeros(toy.PAGE)

    def estimate(self, inference: Inference, levels: int, pilots: Pilots, prior: Real) -> Estimate | None:
        """One measurement of all that is left, under the prior."""
        device = self._device
        device.pilots.append(pilots)
        left = device.drift - device.held - self._known
        if np.abs(left[SHIFT]).max() >= device.seen_px:
            return None
        gain = prior @ np.linalg.inv(prior + np.eye(4) * device.error**2)
        return Estimate(gain @ left, prior - gain @ prior, 0.0)


class FakeTables:
    def __init__(self, device: FakeDevice) -> None:
        self._device = device

    def shifted(self, shift_px: Real) -> SamplingTable:
        return {"shift": shift_px.astype(np.float32)} if np.any(shift_px) else {}

    def tilt_of(self, shift_px: Real) -> Real:
        return np.zeros(2)

    def traced(self, tilt_rad: Real) -> Decoder:
        self._device.traces.append(tilt_rad.copy())
        return FakeDecoder(self._device, tilt_rad.copy())  # type: ignore[return-value]


class FakeSearch:
    def __init__(self, device: FakeDevice) -> None:
        self._device = device

    def find(self, pair: FramePair, pilots: Pilots, around_px: Real) -> FoundImage:
        device = self._device
        device.searches.append(around_px)
        near = np.abs(device.drift[SHIFT] - around_px).max(axis=1).min() <= device.reach_px
        return FoundImage(device.drift[SHIFT] + 0.04 if near else np.zeros(2), 40.0 if near else 5.0, 15.0)


@pytest.fixture
def device(decoder: Decoder) -> FakeDevice:
    return FakeDevice(decoder)


def settled(device: FakeDevice) -> ImageTracker:
    """A tracker that has seen a page where it was."""
    tracker = device.tracker()
    tracker.decode(device.page(), 16)
    device.searches.clear()
    device.decodes.clear()
    return tracker


@pytest.mark.parametrize("shift", [(0.0, 0.0), (2.6, -1.6), (-12.0, 12.0)])
def test_the_image_is_looked_for_before_the_first_page_and_not_before_the_next(
    device: FakeDevice, shift: tuple[float, float]
) -> None:
    device.drift[SHIFT] = shift
    tracker = device.tracker()
    page = tracker.decode(device.page(), 16)
    assert page.image is not None
    assert (page.image.searched, page.image.found) == (True, True)
    assert (page.image.shift_x_px, page.image.shift_y_px) == pytest.approx(shift, abs=1e-3)
    assert len(device.decodes) <= 2  # where it was found, and, if that was a little off, where it lies
    device.decodes.clear()
    page = tracker.decode(device.page(), 16)
    assert page.image is not None
    assert not page.image.searched
    assert len(device.searches) == 1
    np.testing.assert_allclose(device.decodes, [(*shift, 0, 0)], atol=1e-3)


@pytest.mark.parametrize(("shift", "searches"), [((1.0, -0.5), 0), ((-7.0, 9.0), 1)])
def test_a_jump_is_followed_at_once_and_a_knock_out_of_sight_is_searched_for(
    device: FakeDevice, shift: tuple[float, float], searches: int
) -> None:
    tracker = settled(device)
    device.drift[SHIFT] = shift
    page = tracker.decode(device.page(), 16)
    assert len(device.searches) == searches
    assert len(device.decodes) == 2 + searches
    assert [tuple(held[SHIFT]) for held in device.decodes[:1]] == [(0, 0)]
    assert page.image is not None
    assert (page.image.searched, page.image.found) == (bool(searches), bool(searches))
    assert (page.image.shift_x_px, page.image.shift_y_px) == pytest.approx(shift, abs=1e-3)


def test_no_walk_reaches_a_limit(device: FakeDevice) -> None:
    tracker = device.tracker()
    for _ in range(60):
        device.drift[SHIFT] += (0.6, -0.4)
        page = tracker.decode(device.page(), 16)
    assert page.image is not None
    assert (page.image.shift_x_px, page.image.shift_y_px) == pytest.approx((36, -24), abs=1e-3)
    # once walked, it is looked for where it was last as well as where calibration saw it
    device.drift[SHIFT] += 8
    tracker.decode(device.page(), 16)
    np.testing.assert_allclose(device.searches[-1], [[0, 0], [36, -24]], atol=1e-3)


def test_a_page_that_is_nowhere_is_lost_with_its_reason_and_moves_nothing(device: FakeDevice) -> None:
    tracker = settled(device)
    device.drift[SHIFT] = (1.0, 0.0)
    tracker.decode(device.page(), 16)
    before = tracker.state
    device.drift = np.array([40.0, 0.0, 0.0, 0.0])
    for _ in range(3):
        with pytest.raises(UnconfirmedPageError, match="not found") as caught:
            tracker.decode(device.page(), 16)
        assert caught.value.reason is Reason.IMAGE_NOT_FOUND
        assert caught.value.recalibration_due
        assert caught.value.page is not None
        assert caught.value.page.pilot_trust < 0.1
    np.testing.assert_array_equal(tracker.state.drift, before.drift)
    assert len(device.searches) == 3  # each of them was looked for
    device.drift = np.array([1.0, 0.0, 0.0, 0.0])
    device.searches.clear()
    device.decodes.clear()
    assert tracker.decode(device.page(), 16).check.confirmed
    assert (len(device.searches), len(device.decodes)) == (0, 1)  # wrong frames between two pages cost them nothing
    assert tracker.image_px == pytest.approx((1.0, 0.0), abs=1e-3)


def test_where_pilots_are_too_few_to_find_an_image_none_is_looked_for(device: FakeDevice) -> None:
    pilots = device.decoder.pilots(16)
    mask = pilots.mask.copy()
    mask[tuple(axis[3:] for axis in np.nonzero(mask))] = False
    few = Pilots(mask, pilots.phases[:3])
    with pytest.raises(UnconfirmedPageError) as caught:
        device.tracker().decode(device.page(), 16, few)
    assert caught.value.reason is Reason.TOO_FEW_PILOTS
    assert device.searches == []


def test_a_page_whose_image_is_found_but_whose_pilots_disagree_says_that(device: FakeDevice) -> None:
    device.seen_px = 0.0
    with pytest.raises(UnconfirmedPageError, match="px and found") as caught:
        device.tracker().decode(device.page(), 16)
    assert caught.value.reason is Reason.PILOTS_DISAGREE


def test_without_a_search_a_lost_page_is_lost_all_the_same(device: FakeDevice) -> None:
    tracker = device.tracker(search=False)
    assert tracker.decode(device.page(), 16).image is not None
    device.drift[SHIFT] = (5.0, 0.0)
    with pytest.raises(UnconfirmedPageError) as caught:
        tracker.decode(device.page(), 16)
    assert caught.value.reason is Reason.PILOTS_DISAGREE


@pytest.mark.parametrize("read_before", [False, True])
def test_a_device_that_has_changed_for_good_is_searched_once_and_answered(
    read_before: bool, device: FakeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its pilots confirm half of the claim wherever the image is looked at."""
    tracker = settled(device) if read_before else device.tracker()
    monkeypatch.setattr("lightpage.page.pilots.SOUND_SHARE", 1.5)
    if read_before:
        monkeypatch.setattr(PilotCheck, "share", property(lambda _: 0.6))
    pages = [tracker.decode(device.page(), 16) for _ in range(5)]
    assert len(device.searches) == 1
    assert all(page.check.recalibration_due for page in pages)


def test_pages_that_differ_from_one_another_are_not_searched_for(
    device: FakeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Few pilots in dim light confirm now more and now less of what is claimed, on a device that is as it was."""
    tracker = settled(device)
    rng = np.random.default_rng(6)
    shares = [float(rng.uniform(0.6, 1.1)) for _ in range(30)]
    read = iter(shares)
    monkeypatch.setattr(PilotCheck, "share", property(lambda _: next(read, 0.8)))
    monkeypatch.setattr("lightpage.page.pilots._NOISE_DEVIATIONS", 1e6)
    for _ in range(10):
        tracker.decode(device.page(), 16)
    assert device.searches == []


def test_the_filter_believes_a_page_as_far_as_its_error_allows(device: FakeDevice) -> None:
    device.error = 0.03
    tracker = settled(device)
    for _ in range(60):
        tracker.decode(device.page(), 16)
    # the steady state of a random walk under noise: P = (walk^2 + sqrt(walk^4 + 4 walk^2 error^2)) / 2
    walk = WALK[0]
    variance = (walk**2 + np.sqrt(walk**4 + 4 * walk**2 * device.error**2)) / 2
    assert tracker.state.covariance[0, 0] == pytest.approx(variance, rel=1e-3)
    device.drift[SHIFT] = (0.05, -0.05)
    before = tracker.state.drift[SHIFT].copy()
    tracker.decode(device.page(), 16)
    gain = variance / (variance + device.error**2)
    np.testing.assert_allclose(tracker.state.drift[SHIFT] - before, gain * (device.drift[SHIFT] - before), rtol=0.02)


def test_a_large_tilt_is_traced_into_the_table_and_a_small_one_is_not(device: FakeDevice) -> None:
    tracker = settled(device)
    device.drift[TILT] = (0.5 * RETRACE_RAD, 0.0)
    for _ in range(8):
        tracker.decode(device.page(), 16)
    assert device.traces == []
    device.drift[TILT] = (4 * RETRACE_RAD, 0.0)
    for _ in range(30):
        tracker.decode(device.page(), 16)
    assert 1 <= len(device.traces) <= 4
    assert tracker.state.drift[TILT][0] == pytest.approx(4 * RETRACE_RAD, rel=0.05)
    assert device.decodes[-1][TILT][0] == pytest.approx(4 * RETRACE_RAD, abs=1.1 * RETRACE_RAD)


def test_attempts_are_bounded_where_the_image_flees_and_a_fork_learns_on_its_own(
    device: FakeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    tracker = settled(device)
    infer = FakeDecoder.infer

    def fleeing(
        self: FakeDecoder,
        pair: FramePair,
        table: SamplingTable | None = None,
        pilots: Pilots | None = None,
        *,
        doubtful: bool = False,
        limit: StepLimit | None = None,
    ) -> Inference:
        device.drift[SHIFT] += 1.0
        return infer(self, pair, table)

    monkeypatch.setattr(FakeDecoder, "infer", fleeing)
    fork = tracker.fork()
    fork.decode(device.page(), 16)
    assert len(device.decodes) == 1 + CORRECTIONS
    assert fork.state.drift[0] > 1.0
    assert tracker.state.drift[0] == pytest.approx(0.0, abs=1e-3)


def test_what_was_learnt_goes_over_as_text_and_decodes_the_next_page_the_same(device: FakeDevice) -> None:
    tracker = device.tracker()
    tracker.decode(device.page(), 16)
    device.drift = np.array([0.5, -0.3, 2 * RETRACE_RAD, 0.0])
    for seed in range(2, 5):
        tracker.decode(device.page(seed), 16)
    assert tracker.state.traced_tilt.any()
    other = device.tracker(memory=TrackerMemory.model_validate_json(tracker.memory().model_dump_json()))
    assert other.memory() == tracker.memory()
    assert np.array_equal(other.state.table["shift"], tracker.state.table["shift"])
    device.decodes.clear()
    for each in (tracker, other):
        each.decode(device.page(5), 16)
    half = len(device.decodes) // 2
    assert np.array_equal(device.decodes[:half], device.decodes[half:])
    assert other.memory() == tracker.memory()


def test_pages_decoded_at_the_same_time_are_taken_in_their_order(device: FakeDevice, monkeypatch: Any) -> None:
    """In batches, a page that was decoded ahead is decoded again where the page before shows that the image moved."""
    device.together = 2
    monkeypatch.setattr(OneByOne, "put_off", put_off := Mock())
    tracker = settled(device)
    put_off.assert_called_once()  # no batch waits for a page whose image is looked for
    device.drift[SHIFT] = (0.5, 0.0)
    first, second = tracker.turn(), tracker.turn()
    with ThreadPoolExecutor(1) as pool:
        behind = pool.submit(tracker.decode, device.page(2), 16, None, second)
        eventually(lambda: len(device.decodes) == 1)
        image = tracker.decode(device.page(1), 16, None, first).image
        assert behind.result().image is not None
    assert behind.result().timings.turn_s > 0
    assert image is not None
    assert image.shift_x_px == pytest.approx(0.5, abs=0.01)
    assert [round(float(held[0]), 1) for held in device.decodes] == [0.0, 0.0, 0.5, 0.5]


@pytest.mark.parametrize(("error", "most"), [(1e-6, 0.03), (0.14, 0.05)])
def test_in_batches_a_page_is_read_near_where_it_was_looked_at(device: FakeDevice, error: float, most: float) -> None:
    device.together, device.error = 2, error
    tracker, away = settled(device), list[float]()
    for _ in range(24):
        device.drift[SHIFT] += 0.008
        tracker.decode(device.page(), 16)
        away.append(float(np.abs(tracker.state.untraced[SHIFT]).max()))
    assert most / 2 < max(away) <= most


def test_without_batches_pages_wait_for_none_and_teach_once(device: FakeDevice, monkeypatch: Any) -> None:
    tracker, learnt = settled(device), list[ImageState]()
    device.drift[SHIFT] = (0.5, 0.0)

    def meanwhile(_: FramePair) -> None:
        monkeypatch.undo()
        tracker.decode(device.page(), 16)
        learnt.append(tracker.state)

    monkeypatch.setattr(device.decoder, "check", meanwhile)
    tracker.decode(device.page(), 16)
    assert tracker.state is learnt[0]


def test_a_turn_that_is_never_used_holds_nobody_up_who_leaves_or_once_it_is_closed(device: FakeDevice) -> None:
    device.together = 2
    tracker = settled(device)
    hanging = tracker.turn()
    with pytest.raises(CallerLeft):
        tracker.decode(device.page(), 16, None, tracker.turn(Mock(side_effect=CallerLeft)))
    hanging.close()
    dark = FramePair(*(np.zeros_like(frame) for frame in vars(device.page()).values()))
    with pytest.raises(FrameError):
        tracker.decode(dark, 16)
    assert tracker.decode(device.page(), 16).check.confirmed


def test_a_page_is_read_by_the_pilots_that_came_with_it(device: FakeDevice) -> None:
    symbols = np.random.default_rng(4).integers(16, size=toy.PAGE).astype(np.uint8)
    mask = np.zeros(toy.PAGE, bool)
    mask[::3, ::4] = True
    own = Pilots.of_symbols(mask, symbols, 16)
    device.tracker().decode(toy.ToyDevice().page(symbols, 16), 16, own)
    assert all(pilots is own for pilots in device.pilots)


def test_the_time_of_a_page_counts_its_search_and_every_attempt(device: FakeDevice) -> None:
    page = device.tracker().decode(device.page(), 16)
    assert page.timings.search_s > 0
    parts = vars(page.timings).values()
    assert page.timings.total_s == pytest.approx(sum(parts))


def test_the_walk_of_a_restless_device_is_learnt(device: FakeDevice) -> None:
    device.error = 0.03
    rng = np.random.default_rng(0)
    tracker = settled(device)
    for _ in range(40):
        device.drift[SHIFT] += rng.normal(0, 0.09, 2)
        tracker.decode(device.page(), 16)
    assert 0.04 < np.sqrt(tracker.state.walk[0]) < 0.2
    # so a step is believed that a quiet device would not have made
    before = tracker.state.drift[0]
    device.drift[0] = before + 0.09
    tracker.decode(device.page(), 16)
    assert tracker.state.drift[0] - before > 0.06
    quiet = settled(FakeDevice(device.decoder, error=0.03))
    assert quiet.state.walk[0] == WALK[0] ** 2


def test_a_knock_says_nothing_of_the_walk(device: FakeDevice) -> None:
    tracker = settled(device)
    for knock in ((1.5, -1.0), (9.0, 9.0)):
        device.drift[SHIFT] = knock
        tracker.decode(device.page(), 16)
        np.testing.assert_array_equal(tracker.state.walk, WALK**2)


class NoiseDecoder(FakeDecoder):
    """Says of every page whatever it likes, and is very sure of it."""

    rng = np.random.default_rng(8)

    def infer(
        self,
        pair: FramePair,
        table: SamplingTable | None = None,
        pilots: Pilots | None = None,
        *,
        doubtful: bool = False,
        limit: StepLimit | None = None,
    ) -> Inference:
        sure = replace(self._decoder.infer(pair), concentration=np.full(toy.PAGE, 300.0, np.float32))
        return sure.turned(self.rng.uniform(-np.pi, np.pi, toy.PAGE))


class CurvedReference(FakeTables):
    """Over which an image tilts as it shifts, if the reference stays."""

    def __init__(self, device: FakeDevice, kind: type[FakeDecoder]) -> None:
        super().__init__(device)
        self._kind = kind

    def tilt_of(self, shift_px: Real) -> Real:
        return 0.2 * shift_px

    def traced(self, tilt_rad: Real) -> Decoder:
        return self._kind(self._device, tilt_rad.copy())  # type: ignore[return-value]


def over_a_reference(device: FakeDevice, kind: type[FakeDecoder]) -> ImageTracker:
    """A tracker with the slopes of `tests.runtime.model.decoding.test_image_drift`."""
    decoder = kind(device, np.zeros(2))
    return ImageTracker(decoder, DriftModel(SLOPES), CurvedReference(device, kind), None)  # type: ignore[arg-type]


@pytest.mark.parametrize("pilots", [2, 12])
def test_noise_is_not_given_out_however_few_the_pilots_are(device: FakeDevice, pilots: int) -> None:
    """Piston and drift are fitted to the same pilots that then confirm the page: few would confirm anything."""
    tracker = over_a_reference(device, NoiseDecoder)
    mask = np.zeros(toy.PAGE, bool)
    mask.flat[np.linspace(0, mask.size - 1, pilots).astype(int)] = True
    known = Pilots.of_symbols(mask, toy.symbols_of(16, 1)[0], 16)
    for _ in range(250):
        with pytest.raises(UnconfirmedPageError):
            tracker.fork().decode(device.page(), 16, known)


class PhaseDecoder(FakeDecoder):
    """Shows drift in its phases alone, by the slopes of `tests.runtime.model.decoding.test_image_drift`."""

    def infer(
        self,
        pair: FramePair,
        table: SamplingTable | None = None,
        pilots: Pilots | None = None,
        *,
        doubtful: bool = False,
        limit: StepLimit | None = None,
    ) -> Inference:
        device = self._device
        shift = (table or {}).get("shift", np.zeros(2))
        device.held = np.concatenate([np.asarray(shift, np.float64), self._tilt])
        inference = self._decoder.infer(pair)
        return inference.turned(DriftModel(SLOPES).phase_change(device.drift - device.held))


@pytest.mark.parametrize("stays", [False, True])
def test_the_pilots_say_whether_the_reference_has_come_along(device: FakeDevice, stays: bool) -> None:
    tracker = over_a_reference(device, PhaseDecoder)
    tracker.decode(device.page(), 16)
    device.drift = np.array([0.6, -0.3, 0.12 * stays, -0.06 * stays])
    page = tracker.decode(device.page(), 16)
    assert page.check.sound
    np.testing.assert_allclose(tracker.state.drift[SHIFT], device.drift[SHIFT], atol=0.05)
    # what is known of tilt before a jump would leave most of it out
    np.testing.assert_allclose(tracker.state.drift[TILT], device.drift[TILT], atol=0.02)
