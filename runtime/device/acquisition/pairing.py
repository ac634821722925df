"""Tells which two frames belong to one shot: a frame is of this trigger only if its own camera's clock says so.

Cameras count the frames that they took, so one missed trigger shifts all later numbers. Neither order of arrival nor
equal numbers nor the nearest time tell whose a frame is. So one trigger is in flight at a time, and a pair counts only
where every one of these rules holds:

1. No frame waits before the trigger, and none is left over after both frames are in.
2. Both frames are complete. Number and time of any other may be those of an earlier frame.
3. Both numbers follow their camera's last one by the step that the synchronisation saw, mostly 1. After a fault they
   are not known, and anything may follow.
4. For each camera, device time less the time of the trigger is within a tolerance of the camera's reference. This
   reference comes from three shots at unequal distances that agree, follows accepted shots, and expires before the
   clocks can have drifted apart by a quarter of the tolerance.
5. The page was on display for at least the tolerance before the trigger, and still is when both frames are in.

A frame of another shot is off by at least the distance of two shots, which is more than twice the tolerance: rule 4
excludes it. A trigger edge that is late by so much that it looks like the next shot's still exposes the page that is on
display then: rule 5. The other rules say what went wrong.

Three shots in a row that are lost to rules 1, 3 or 4 are no accident: a camera's counter or clock has begun anew or
stepped, or its trigger is off. What is remembered is dropped then, and learnt again before the next shot.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Self

from pydantic import Field, model_validator

from lightpage.clock import SYSTEM, Clock
from lightpage.device.profile import StrictTable
from lightpage.errors import LostShotError, Reason
from lightpage.progress import note
from lightpage.runtime.device.cameras.camera import BrokenFrame, Camera, Frame
from lightpage.runtime.device.trigger.trigger import Trigger
from lightpage.words import counted

_GAPS = (0.0, 3.0, 7.0)
"""Distances of the three shots of a synchronisation beyond the least one, in tolerances: unequal, so that a queue that
is one frame behind shows."""
_TRIES = 8
"""Synchronisations in a row."""
_SILENT_TRIES = 3
"""The same where a camera has sent no frame since the start: its trigger does not arrive, and waiting mends nothing."""
_MOST_QUIET = 20
"""A line that is never silent is given up after so many times the silence that is waited for."""
_MOST_DRAINED = 512
"""Frames that are dropped at a time; no camera keeps so many. One that sends faster than that is never silent."""
CONTRADICTIONS = 3
"""Lost shots in a row after which what is remembered of the devices is dropped."""
_CONTRADICTING = frozenset({Reason.SKIPPED_FRAME, Reason.STRAY_FRAME, Reason.OTHER_SHOT})
_WRAPS = frozenset({2**16 - 1, 2**32 - 1})
"""Last numbers of counters; some go on with 0 and some with 1, whatever their driver says."""
_MOST_STEP = 16
"""A camera whose numbers grow by more from shot to shot is lost track of."""
_FOLLOWING = 0.1
"""Share of an accepted shot's deviation by which the reference follows."""


class PairingSettings(StrictTable):
    """Tolerances of telling frames apart."""

    tolerance_s: Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)] = 0.02
    """Largest deviation of a frame's time. Wider: fewer lost shots, and slower ones."""
    frame_s: Annotated[float, Field(gt=0, le=600, allow_inf_nan=False)] = 0.5
    """Longest wait for both frames. Longer than the exposure."""
    quiet_s: Annotated[float, Field(gt=0, le=60, allow_inf_nan=False)] = 0.15
    """Silence that ends a fault."""
    spacing_s: Annotated[float, Field(gt=0, le=60, allow_inf_nan=False)] = 0.06
    """Least time from trigger to trigger. At least 2.5 `tolerance_s`."""
    clock_drift: Annotated[float, Field(gt=0, le=0.01, allow_inf_nan=False)] = 1e-4
    """Drift of a camera's clock against this machine's that is allowed for, relative."""

    @model_validator(mode="after")
    def _tells_shots_apart(self) -> Self:
        if self.spacing_s < (least := 2.5 * self.tolerance_s):
            raise ValueError(f"spacing_s = {self.spacing_s:g}, wanted at least {least:g}, 2.5 tolerances")
        return self

    @property
    def expires_s(self) -> float:
        """Age from which a reference is no longer relied on."""
        return self.tolerance_s / (4 * self.clock_drift)


@dataclass
class _Channel:
    """A camera, and the state of its clock and frames.

    Attributes:
        last_id: number of its last frame, None where it is not known.
        step: step by which its numbers grow from shot to shot, None where it is not known.
        reference_s: device time less trigger time of a good shot, None before a synchronisation.
        opened: how often the camera was opened when that was learnt.
        came: frames so far, whole or not.
    """

    camera: Camera
    last_id: int | None = None
    step: int | None = None
    reference_s: float | None = None
    opened: int = -1
    came: int = 0

    def frame(self, timeout_s: float) -> Frame | BrokenFrame | None:
        """The camera's next frame, counted."""
        frame = self.camera.frame(timeout_s)
        self.came += frame is not None
        return frame

    def forget(self) -> None:
        """Know nothing any more."""
        self.last_id = self.step = self.reference_s = None
        self.opened = self.camera.opened


@dataclass
class Pairing:
    """Takes pairs of frames. One thread at a time uses it.

    Args:
        cameras: in-phase and quadrature, armed.
        trigger: armed.
        settings: how strict.
        clock: clock by which it waits, and `trigger` tells the time of its shots.
    """

    cameras: Sequence[Camera]
    trigger: Trigger
    settings: PairingSettings = field(default_factory=PairingSettings)
    clock: Clock = SYSTEM

    def __post_init__(self) -> None:
        self._channels = [_Channel(camera) for camera in self.cameras]
        self._referenced_at = -float("inf")
        self._next_at = -float("inf")
        self._settled = False
        self._contradictions = self._skips = 0
        """Lost shots in a row, and those that numbers contradict among shots whose numbers could be expected."""

    @property
    def distrusted(self) -> bool:
        """Return whether so many shots in a row contradict the memory that the devices may have lost their settings."""
        return max(self._contradictions, self._skips) >= CONTRADICTIONS

    @property
    def synchronised(self) -> bool:
        """Return whether frames can be told apart now, without a synchronisation before."""
        fresh = self.clock.now() - self._referenced_at < self.settings.expires_s
        return fresh and all(
            channel.reference_s is not None and channel.opened == channel.camera.opened for channel in self._channels
        )

    @property
    def silent(self) -> list[str]:
        """Cameras that have sent no frame since the start."""
        return [channel.camera.name for channel in self._channels if not channel.came]

    def forget(self) -> None:
        """Synchronise before the next shot: a device that was set up anew may be slower, or another one."""
        self._referenced_at = -float("inf")
        self._contradictions = self._skips = 0

    def shot(
        self, deadline: float, display: Callable[[], None] | None = None, displayed: Callable[[], bool] | None = None
    ) -> tuple[Frame, ...]:
        """Take one pair, synchronised before where that is needed.

        Args:
            deadline: time by the clock after which no more trigger is fired.
            display: puts the page on display and returns once it is; called once, before the first trigger.
            displayed: whether the page is still on display.

        Raises:
            LostShotError: there is no pair, and why. The next shot begins with silence.
        """
        try:
            if display is not None:
                display()
            self._displayed_at = self.clock.now()
            if not self._settled:
                self._settle(deadline)
            if self.distrusted:
                self.forget()
            if not self.synchronised:
                self._synchronise(deadline)
            numbered = all(channel.last_id is not None for channel in self._channels)
            frames, offsets_s = self._take(deadline)
            self._check_times(offsets_s)
            if displayed is not None and not displayed():
                raise LostShotError("page", "no longer on display", "there until both are in", Reason.NOT_ON_DISPLAY)
        except BaseException as error:
            self._settled = False
            if isinstance(error, LostShotError):
                self._contradictions += error.reason in _CONTRADICTING
                self._skips += error.reason is Reason.SKIPPED_FRAME
                if error.reason in (Reason.CAMERA_GONE, Reason.TRIGGER_GONE):
                    self.forget()
            raise
        self._contradictions = 0
        if numbered:
            self._skips = 0
        return frames

    def _check_times(self, offsets_s: tuple[float, ...]) -> None:
        """Check both frames' times against the trigger (rule 4), and update the reference times."""
        deviations = [offset - (one.reference_s or 0.0) for one, offset in zip(self._channels, offsets_s, strict=True)]
        if max(map(abs, deviations)) > self.settings.tolerance_s:
            told = ", ".join(
                f"{channel.camera.name} {1e3 * deviation:+.1f} ms"
                for channel, deviation in zip(self._channels, deviations, strict=True)
            )
            expected = f"at most {1e3 * self.settings.tolerance_s:g} ms after the trigger's usual time"
            raise LostShotError("frames", told, expected, Reason.OTHER_SHOT)
        for channel, deviation in zip(self._channels, deviations, strict=True):
            channel.reference_s = (channel.reference_s or 0.0) + _FOLLOWING * deviation
        self._referenced_at = self.clock.now()

    def _synchronise(self, deadline: float) -> None:
        """Learn the references from three shots that agree.

        Raises:
            LostShotError: `NOT_SYNCHRONISED`, or a fault that no further try mends.
        """
        tolerance = self.settings.tolerance_s
        last: LostShotError | None = None
        for tried in range(1, _TRIES + 1):
            for channel in self._channels:
                channel.forget()
            try:
                self._settle(deadline)
                offsets = []
                for gap in _GAPS:
                    self._next_at += gap * tolerance
                    offsets.append(self._take(deadline)[1])
                each = [sorted(of_one) for of_one in zip(*offsets, strict=True)]
                spread = max(ordered[-1] - ordered[0] for ordered in each)
                if spread <= tolerance:
                    for channel, ordered in zip(self._channels, each, strict=True):
                        channel.reference_s = ordered[len(ordered) // 2]
                    self._referenced_at = self.clock.now()
                    note("cameras and trigger are synchronised")
                    return
                told = f"times that differ by {1e3 * spread:.1f} ms"
                last = LostShotError("three shots", told, f"at most {1e3 * tolerance:g} ms", Reason.NOT_SYNCHRONISED)
            except LostShotError as error:
                if error.reason in (Reason.CAMERA_GONE, Reason.TRIGGER_GONE, Reason.TRIGGER_REFUSED):
                    raise
                if error.reason is Reason.MISSING_FRAME and tried >= _SILENT_TRIES and self.silent:
                    raise self._never(tried) from None
                last = error
            if self.clock.now() > deadline:
                break
        told = f"{last.subject}: {last.got} ({last.reason.value})" if last is not None else "no time left"
        raise LostShotError("synchronisation", told, "three shots that agree", Reason.NOT_SYNCHRONISED)

    def _never(self, triggers: int) -> LostShotError:
        """The error of cameras that no trigger seems to reach."""
        return LostShotError(
            " and ".join(self.silent),
            f"no frame since the start, after {counted(triggers, 'trigger')}",
            "a frame for each: look at trigger_source, at the trigger's channels and its cable, "
            f"and whether frame_s ({self.settings.frame_s:g} s) is longer than the exposure",
            Reason.MISSING_FRAME,
        )

    def _take(self, deadline: float) -> tuple[tuple[Frame, ...], tuple[float, ...]]:
        """Fire once, and take both frames by rules 1 to 3, the page on display for long enough before.

        Returns:
            The frames, and each one's device time less the trigger's, seconds.
        """
        settings = self.settings
        earliest = max(self._next_at, self._displayed_at + settings.tolerance_s)
        if earliest > deadline or self.clock.now() > deadline:
            raise _no_time_left()
        self.clock.sleep(earliest - self.clock.now())
        if self._drain():
            raise LostShotError("frame", "one before the trigger", "none", Reason.STRAY_FRAME)
        fired = self.trigger.fire()
        self._next_at = self.clock.now() + settings.spacing_s
        end = self.clock.now() + settings.frame_s
        frames = [self._checked(one, one.frame(max(1e-3, end - self.clock.now()))) for one in self._channels]
        if self._drain():
            raise LostShotError("frame", "one more than the trigger asked for", "two", Reason.STRAY_FRAME)
        for channel, frame in zip(self._channels, frames, strict=True):
            channel.last_id = frame.info.frame_id
        return tuple(frames), tuple(frame.info.device_time_s - fired for frame in frames)

    def _checked(self, channel: _Channel, frame: Frame | BrokenFrame | None) -> Frame:
        """A frame that came, by rules 2 and 3."""
        name = channel.camera.name
        if frame is None:
            wanted = f"one within {self.settings.frame_s:g} s of the trigger"
            raise LostShotError(f"{name}: frame", "none", wanted, Reason.MISSING_FRAME)
        if isinstance(frame, BrokenFrame):
            raise LostShotError(f"{name}: frame", frame.detail, "all of it", Reason.INCOMPLETE_FRAME)
        if channel.last_id is not None:
            number, last = frame.info.frame_id, channel.last_id
            step = (number - last) % channel.camera.frame_numbers
            if channel.step is None and 1 <= step <= _MOST_STEP:
                channel.step = step
            if step != channel.step and not (last in _WRAPS and number in (0, 1)):
                expected = f"{channel.step or 1} after {last}"
                raise LostShotError(f"{name}: frame number", number, expected, Reason.SKIPPED_FRAME)
        return frame

    def _drain(self) -> int:
        """Drop the frames that wait, so many and for so long at most; returns how many there were."""
        dropped, end = 0, self.clock.now() + self.settings.quiet_s
        for channel in self._channels:
            while dropped < _MOST_DRAINED and channel.frame(0.0) is not None:
                dropped += 1
                channel.last_id = None
                if self.clock.now() > end:
                    return dropped
        return dropped

    def _settle(self, deadline: float) -> None:
        """Wait until no frame has come for a while; what came before is not known any more."""
        quiet = self.settings.quiet_s
        end = self.clock.now() + quiet
        give_up, came = min(deadline, end + _MOST_QUIET * quiet), 0
        while (now := self.clock.now()) < end:
            if now > give_up and came:
                raise LostShotError("cameras", "frames without end", f"silence for {quiet:g} s", Reason.STRAY_FRAME)
            if now > give_up:
                raise _no_time_left()
            if dropped := self._drain():
                came, end = came + dropped, self.clock.now() + quiet
            self.clock.sleep(0.005)
        for channel in self._channels:
            channel.last_id = None
        self._next_at = max(self._next_at, self.clock.now())
        self._settled = True


def _no_time_left() -> LostShotError:
    return LostShotError("shot", "no time left", "a longer wait", Reason.MISSING_FRAME)
