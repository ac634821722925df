"""Two cameras, a trigger, a modulator and the beams' shutters as one source of pages."""

import logging
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from lightpage.clock import SYSTEM, Clock
from lightpage.device.profile import Profile, StrictTable
from lightpage.errors import LostShotError, Reason, SourceError, raised_as
from lightpage.page.levels import MAX_LEVELS
from lightpage.recording.exposure import check_pair_light
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.pixels.black_level import DarkFrame
from lightpage.runtime.device.acquisition.beam_keeper import BeamKeeper
from lightpage.runtime.device.acquisition.camera_image import CameraImage, Counts, View
from lightpage.runtime.device.acquisition.page_store import PageStore
from lightpage.runtime.device.acquisition.pairing import Pairing, PairingSettings
from lightpage.runtime.device.acquisition.source import SHOT_S, FrameSource, Shot, own_fault
from lightpage.runtime.device.cameras.camera import Camera, Frame
from lightpage.runtime.device.modulator.modulator import Beams, Modulator
from lightpage.runtime.device.trigger.trigger import Trigger

_Attempt = Callable[[], tuple[Frame, ...]]

_log = logging.getLogger(__name__)

_GONE = frozenset({Reason.CAMERA_GONE, Reason.TRIGGER_GONE})
_AWAITED = _GONE | {Reason.BEAM_CONTROL_FAILED}
"""What mends itself, or somebody does: it is waited for until the shot's time is up."""
_DISARMING = _GONE | {Reason.MISSING_FRAME, Reason.TRIGGER_REFUSED}
"""A device is set up again: one that was switched off and on for a moment answers, and waits for no trigger."""
_MOST_REPEATS = 20
"""Of a shot of reference or dark frames."""
_AGAIN_S = 0.5
"""Between two attempts to reach a device that has gone."""


class Exposures(StrictTable):
    """Numbers and times of exposures."""

    repeats: Annotated[int, Field(ge=0, le=100)] = 1
    """Further shots of a page whose shot is lost."""
    reference_frames: Annotated[int, Field(ge=1, le=256)] = 8
    """Shots that make the mean reference frame."""
    dark_frames: Annotated[int, Field(ge=1, le=256)] = 8
    """Shots that make the mean dark frame."""
    shot_s: Annotated[float, Field(gt=0, le=3600, allow_inf_nan=False)] = SHOT_S
    """Longest wait for a page, repeats included."""


class CameraSource(FrameSource):
    """Shows a page, triggers both cameras and pairs their frames.

    A shot that is lost is repeated while its page is on display. A device that has gone is looked for until the shot's
    time is up; the first shot after it is back finds it.

    Args:
        profile: nominal device.
        cameras: in-phase and quadrature.
        trigger: fires both.
        modulator: shows the pages; None where something else does, which then is to hold one page still for each shot.
        beams: block signal and reference beam.
        pages: what the modulator shows.
        pairing: how strictly frames are told apart.
        exposures: how they are taken.
        views: how each camera sees the image.
        name: name for people.
        clock: clock by which it waits; that of the trigger.

    Raises:
        SourceError: the cameras' bit depths differ.
    """

    def __init__(
        self,
        profile: Profile,
        cameras: tuple[Camera, Camera],
        trigger: Trigger,
        modulator: Modulator | None,
        beams: Beams,
        pages: PageStore | None = None,
        pairing: PairingSettings | None = None,
        exposures: Exposures | None = None,
        views: tuple[View, View] = (View(), View()),
        name: str = "camera",
        clock: Clock = SYSTEM,
    ) -> None:
        self.name, self.profile = name, profile
        self.frame_shape, self.page_shape = profile.frame_shape, profile.page_shape
        self.modulator = modulator
        self.beams: Beams = beams
        self.pages: PageStore = pages if pages is not None else PageStore(profile)
        self.cameras, self._trigger = cameras, trigger
        self.images = tuple(map(CameraImage, cameras, views))
        depths = [camera.bit_depth for camera in cameras]
        if depths[0] != depths[1]:
            raise SourceError(f"{self.name}: cameras", f"{depths[0]} and {depths[1]} bits", "the same for both")
        self.bit_depth = depths[0]
        self._exposures = exposures or Exposures()
        self.shot_s = self._exposures.shot_s
        self._pairing = Pairing(cameras, trigger, pairing or PairingSettings(), clock)
        self._clock = clock
        self._lock = threading.RLock()
        """Held while the devices are used: one shot at a time."""
        self._keeper = BeamKeeper(beams, self._lock, name, clock)
        self._armed = self._was_armed = False
        self._next = 0
        self._outcomes: Counter[str] = Counter()

    @property
    def levels(self) -> int:  # type: ignore[override]  # uploads may settle it
        """Level count of its pages; 256 before any page is known."""
        return self.pages.levels or MAX_LEVELS

    def page_count(self) -> int | None:
        """See `FrameSource.page_count`."""
        count = len(self.pages)
        return count if count or self.modulator is not None else None

    def show_pages(self, pages: PageStore) -> None:
        """See `FrameSource.show_pages`."""
        with self._lock:
            self.pages.close()
            self.pages = pages

    def shots_by_outcome(self) -> Mapping[str, int]:
        """See `FrameSource.shots_by_outcome`."""
        return dict(self._outcomes)

    def saturated_shares(self) -> Mapping[str, float]:
        """See `FrameSource.saturated_shares`."""
        shares = {image.camera.name: image.saturated_share for image in self.images}
        return {name: share for name, share in shares.items() if share is not None}

    def arm(self) -> None:
        """See `FrameSource.arm`."""
        with self._lock:
            if self._armed:
                return
            if not self._was_armed and self.modulator is not None:
                # Settings that are wrong are not to be found after minutes of other shots.
                with raised_as(SourceError, LostShotError):
                    self.modulator.open(SHOT_S, self.pages.levels)
            for camera in self.cameras:
                self._arm(camera, Reason.CAMERA_GONE)
            self._arm(self._trigger, Reason.TRIGGER_GONE)
            self._pairing.forget()
            self._armed = self._was_armed = True

    def _arm(self, device: Camera | Trigger, reason: Reason) -> None:
        """Make one device ready. One that was ready before and cannot be found now has gone, and may come back."""
        try:
            device.arm()
        except SourceError as error:
            if not self._was_armed:
                raise
            raise LostShotError(error.subject, error.got, error.expected, reason) from None

    def disarm(self) -> None:
        """See `FrameSource.disarm`."""
        with self._lock:
            self._armed = False
            for device in (self._trigger, *self.cameras):
                device.disarm()

    def close(self) -> None:
        """See `FrameSource.close`."""
        with self._lock, ExitStack() as stack:  # each is closed, whatever becomes of the others; the beams first
            self._armed = False
            self._keeper.close()
            stack.callback(self.pages.close)
            for device in (self.modulator, *self.cameras, self._trigger, self.beams):
                if device is not None:
                    stack.callback(device.close)

    def trouble(self) -> str:
        """See `FrameSource.trouble`: a beam may be blocked."""
        return self._keeper.trouble

    def shot(self, timeout_s: float = SHOT_S, page: int | None = None) -> Shot:
        """See `FrameSource.shot`."""
        deadline = self._clock.now() + timeout_s
        with self._in_turn(timeout_s):
            index, symbols = self._page(page)
            take = self._attempt(index, symbols, deadline)

            def attempt() -> tuple[Frame, ...]:
                self._keeper.ensure_open()
                return take()

            frames = self._persistent(f"page {index}", index, deadline, attempt, self._exposures.repeats)
            pair = FramePair(*map(CameraImage.cleaned, self.images, frames))
            first, second = frames
            return Shot(pair, index, symbols, None, (first.info, second.info))

    @contextmanager
    def _in_turn(self, timeout_s: float) -> Iterator[None]:
        """Hold the devices, unless others use them for too long."""
        if not self._lock.acquire(timeout=min(max(0.0, timeout_s), threading.TIMEOUT_MAX)):
            if trouble := self._keeper.trouble:
                raise LostShotError(self.name, trouble, "both beams open", Reason.BEAM_CONTROL_FAILED)
            raise LostShotError(self.name, "other shots", f"their end within {timeout_s:g} s", Reason.MISSING_FRAME)
        try:
            yield
        finally:
            self._lock.release()

    def references(self) -> FramePair:
        """Mean of reference-only frames, taken now: the signal beam is blocked for them.

        Raises:
            LostShotError: they could not be taken.
            SourceError: they are dark or saturated, or this device cannot block its signal beam.
        """
        with self._lock, self._keeper.blocked(signal=False, reference=True):
            stacks = self._stacks(self._exposures.reference_frames, CameraImage.cleaned)
            means = [np.rint(stack.mean(axis=0)).astype(stack.dtype) for stack in stacks]
        pair = FramePair(means[0], means[1])
        with own_fault():
            check_pair_light(f"{self.name}: reference ", pair, self.bit_depth)
        return pair

    def dark_frames(self) -> tuple[DarkFrame, DarkFrame]:
        """Return what both cameras see without light, taken now; black level and hot pixels are minded from here on.

        Raises:
            LostShotError: they could not be taken.
            SourceError: there was light, or this device cannot block its beams.
        """
        with self._lock, self._keeper.blocked(signal=False, reference=False):
            stacks = self._stacks(self._exposures.dark_frames, CameraImage.upright)
            with own_fault():
                first, second = (
                    DarkFrame.of(stack, self.bit_depth, f"{camera.name}: dark frames")
                    for stack, camera in zip(stacks, self.cameras, strict=True)
                )
            for image, dark in zip(self.images, (first, second), strict=True):
                image.mind(dark)
                _log.info("%s: black level %d, %d hot pixels", image.camera.name, dark.black_level, len(dark.hot))
            return first, second

    def _page(self, page: int | None) -> tuple[int, NDArray[np.uint8] | None]:
        """Number and symbols of page `page`, or of the next one; without pages of its own the number only counts."""
        count = len(self.pages)
        if page is None:
            page, self._next = self._next, self._next + 1
            page = page % count if count else page
        if not count and self.modulator is None:
            return page, None
        return page, self.pages[page]

    def _attempt(self, index: int, symbols: NDArray[np.uint8] | None, deadline: float) -> _Attempt:
        """Return what takes a pair of a page. A further attempt leaves the page as it stands, where it still does."""
        modulator, shown = self.modulator, False
        if modulator is None or symbols is None:
            return lambda: self._pairing.shot(deadline)

        def display() -> None:
            nonlocal shown
            if not (shown and modulator.shows()):
                shown = False
                modulator.show(symbols, self.levels, index, max(0.0, deadline - self._clock.now()))
                shown = True

        return lambda: self._pairing.shot(deadline, display, modulator.shows)

    def _persistent(
        self, subject: str, index: int, deadline: float, attempt: _Attempt, repeats: int
    ) -> tuple[Frame, ...]:
        """A pair of one page: lost shots are repeated, and devices that have gone are waited for."""
        while True:
            try:
                self.arm()
                frames = attempt()
            except LostShotError as error:
                self._outcomes[error.reason.value] += 1
                self.on_lost(index, error)
                if error.reason in _DISARMING or self._pairing.distrusted:
                    self._armed = False
                # No trigger has ever reached a camera, which no repeat mends.
                never_came = error.reason is Reason.MISSING_FRAME and self._pairing.silent
                if error.reason in _AWAITED:
                    if self._clock.now() + _AGAIN_S < deadline:
                        self._clock.sleep(_AGAIN_S)
                        continue
                elif repeats > 0 and self._clock.now() < deadline and not never_came:
                    repeats -= 1
                    continue
                raise error.about(f"{subject} of {self.name}") from None
            except SourceError:
                self._armed = False  # whatever refuses is set up again before the next shot
                raise
            self._outcomes["TAKEN"] += 1
            return frames

    def _stacks(self, count: int, counts_of: Callable[[CameraImage, Frame], Counts]) -> list[Counts]:
        """Counts of frames of both cameras [exposure, row, column], whatever is on display."""
        shots = []
        for _ in range(count):
            deadline = self._clock.now() + self.shot_s
            # nothing but the light has to stand still, so there is no reason to give up early
            attempt = partial(self._pairing.shot, deadline)
            shots.append(self._persistent("frames without a page", -1, deadline, attempt, _MOST_REPEATS))
        each = zip(self.images, zip(*shots, strict=True), strict=True)
        return [np.stack([counts_of(image, frame) for frame in frames]) for image, frames in each]
