"""Frames that callers send: checked against the camera, received, decoded with the model in service, and answered."""

import threading
import time

import numpy as np

from lightpage.codec.page_bytes import FileFacts, PageBytes
from lightpage.errors import CallerLeft, FrameError, InvalidInputError, LimitError, PageError
from lightpage.page.levels import check_levels
from lightpage.page.pilots import Pilots
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.wire.messages import PIXEL_TYPES, message_of
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.decoding.turns import Turn, Turns
from lightpage.runtime.service.admission import Bytes, ReceiveBudget
from lightpage.runtime.service.caller import Caller
from lightpage.runtime.service.dataplane import Answer, DataPlane, Seen, levels_for, observed
from lightpage.runtime.service.monitoring import monitor as signs
from lightpage.runtime.service.stages import Stage, Stages

SESSION_CHARACTERS = 1024
"""Of the name of a session, at most: the service remembers it."""


def pilots_of(message: pb.Pilots, bundle: Bundle, levels: int) -> Pilots:
    """Pilots that a caller sent, as the bundle's device shows them.

    Raises:
        PageError: sizes that do not fit the page, or levels out of range.
    """
    page_shape, flags = bundle.profile.page_shape, np.frombuffer(message.mask, np.uint8)
    values = np.frombuffer(message.values, np.uint8)
    if flags.size and int(flags.max()) > 1:
        raise PageError("pilots", f"a flag of {flags.max()}", "flags of 0 or 1")
    if flags.size != page_shape[0] * page_shape[1] or np.count_nonzero(flags) != values.size:
        got = f"{flags.size} flags, {np.count_nonzero(flags)} of them set, and {values.size} values"
        raise PageError("pilots", got, f"{page_shape[0] * page_shape[1]} flags and one value a set flag")
    shown = bundle.levels(message.levels or levels)
    if values.size and int(values.max()) >= shown.count:
        raise PageError("pilots", f"level {values.max()}", f"0..{shown.count - 1}")
    return Pilots(flags.reshape(page_shape) != 0, shown.phases[values])


def check_options(options: pb.DecodeOptions) -> None:
    """Check what a caller asks for, before a frame is received or a page is read for it.

    Raises:
        PageError: an impossible level count; 0 stands for the default.
        InvalidInputError: an unknown format of confidences, or way of tracking, or too long a name of a session.
    """
    if options.levels:
        check_levels(options.levels)
    if options.confidence_format not in pb.ConfidenceFormat.values():
        expected = "CONFIDENCE_FORMAT_FLOAT32 or CONFIDENCE_FORMAT_UINT8"
        raise InvalidInputError("confidence_format", options.confidence_format, expected)
    if options.tracking not in pb.Tracking.values():
        raise InvalidInputError("tracking", options.tracking, "TRACKING_SESSION or TRACKING_STATELESS")
    if (length := len(options.session)) > SESSION_CHARACTERS:
        raise InvalidInputError("session", f"{length} characters", f"at most {SESSION_CHARACTERS}")


def pixel_type(code: pb.PixelType) -> str:
    """numpy's name of a pixel type.

    Raises:
        InvalidInputError: unspecified or unknown.
    """
    if code not in PIXEL_TYPES:
        raise InvalidInputError("pixel_type", code, "PIXEL_TYPE_UINT8 or PIXEL_TYPE_UINT16")
    return PIXEL_TYPES[code]


class PairReceiver:
    """Takes in-phase pixels, then quadrature pixels, in chunks of any size.

    Args:
        shape: (rows, columns) of a frame.
        dtype: "uint8" or "uint16" (little-endian on the wire).
        budget: budget that it takes its bytes from until it is closed.

    Attributes:
        size: bytes of the pair.
        filled: bytes that have come.
    """

    def __init__(self, shape: tuple[int, int], dtype: str, budget: ReceiveBudget) -> None:
        self._shape, self._budget = shape, budget
        self._dtype = np.dtype(dtype).newbyteorder("<")
        self.size = 2 * shape[0] * shape[1] * self._dtype.itemsize
        self._lock = threading.Lock()
        """Held while bytes are taken in, so that nobody lets go of them meanwhile."""
        self._buffer: Bytes | None = None
        self.filled, self._closed = 0, False

    @property
    def complete(self) -> bool:
        """Return whether every pixel has come."""
        return self.filled == self.size

    def add(self, chunk: bytes | memoryview) -> None:
        """Take in the next bytes.

        Raises:
            FrameError: more bytes than the two frames have.
            OverloadedError: more than the budget has.
            CallerLeft: it is closed.
        """
        with self._lock:
            if self._closed:
                raise CallerLeft
            end = self.filled + len(chunk)
            if end > self.size:
                raise FrameError("frame pair", f"at least {end} bytes", f"{self.size} bytes, as the header says")
            self._budget.take(len(chunk))
            if self._buffer is None:
                self._buffer = self._budget.memory(self.size)
            self._buffer[self.filled : end] = np.frombuffer(chunk, np.uint8)
            self.filled = end

    def check(self) -> None:
        """Check that every pixel has come.

        Raises:
            FrameError: bytes are missing.
        """
        if not self.complete:
            raise FrameError("frame pair", f"{self.filled} bytes", f"{self.size} bytes, as the header says")

    def pair(self) -> FramePair:
        """The two frames, views of the one buffer, once every pixel has come."""
        assert self._buffer is not None  # of what is complete
        halves = self._buffer.reshape(2, -1)
        native = self._dtype.newbyteorder("=")
        in_phase, quadrature = (
            half.view(self._dtype).reshape(self._shape).astype(native, copy=False) for half in halves
        )
        return FramePair(in_phase, quadrature)

    def close(self) -> None:
        """Give back what it took from the budget, and take no more."""
        with self._lock:
            self._closed = True
            self._budget.give_back(self.filled)
            if self._buffer is not None:
                self._budget.spare(self._buffer)
            self.filled, self._buffer = 0, None


def check_format(plane: DataPlane, shape: tuple[int, int], dtype: str, bit_depth: int) -> None:
    """Check what a caller says of frames against the camera, before a byte is allocated for them.

    Raises:
        LimitError: the pair is larger than the service accepts.
        FrameError: not this device's size, type or bit depth.
    """
    # Size first: a header may claim anything, and a limit is the service's, not the camera's.
    if (size := 2 * shape[0] * shape[1] * np.dtype(dtype).itemsize) > (most := plane.limits.pair_bytes):
        raise LimitError("frame pair", f"{size} bytes", f"at most {most}")
    bundle = plane.models.current.decoder.bundle
    expected = (bundle.profile.frame_shape, bundle.manifest.frame_dtype, bundle.manifest.camera_bit_depth)
    if (shape, dtype, bit_depth) != expected:
        raise FrameError(
            "frame pair",
            f"{shape[0]}x{shape[1]} pixels, {dtype}, {bit_depth} bits",
            f"{expected[0][0]}x{expected[0][1]} pixels, {expected[1]}, {expected[2]} bits",
        )


def decode(
    plane: DataPlane,
    pair: FramePair,
    levels: int | None,
    caller: Caller,
    pilots: Pilots | None = None,
    *,
    user_data: bool = False,
    version: str = "",
    stages: Stages | None = None,
    order: Turn | None = None,
) -> Answer:
    """Decode a pair with the model in service.

    Args:
        plane: the service.
        pair: both frames.
        levels: M; None stands for `default_levels`, or for that of the code where user bytes are asked for.
        caller: who waits; nothing is computed for one who has gone.
        pilots: known symbols where they differ from the device's pattern.
        user_data: whether to read the page's bytes too.
        version: version of the model that must be in service; empty for any.
        stages: times the page.
        order: order of the pages of its call, in which they are followed; by default it is alone.

    Raises:
        BundleError: user bytes are asked for, and the model has no code.
        InvalidInputError: they are, and `levels` are not the code's.
        OtherModelError: another model is in service.
        SlotsTakenError: no slot until the caller's time is up.
        CallerLeft: the caller has gone.
        UnconfirmedPageError, FrameError, PageError: see `Tracker.decode`.
    """
    stages = stages or Stages()
    stages.begin(Stage.QUEUE)
    with order or Turns().take() as order, plane.slot(caller):
        began = time.perf_counter()
        # Taken once: a swap in the meantime changes the next request, not this one.
        model = plane.models.expect(version)
        sure = pilots is None
        levels = levels_for(model.decoder, levels, plane.default_levels, user_data)
        if user_data:
            pilots = pilots or model.decoder.written_pilots(levels)
        subject, monitor = "frame pair", plane.monitors.of(caller)
        seen = Seen(subject, None, model.version)
        seen.note(tells=sure, pair=pair, of_device=monitor is not None and monitor is plane.monitors.device)
        with observed(plane.monitors.told_by(monitor), seen):
            with plane.optics(user_data), plane.place(model, caller) as place:
                order.close()
                page = plane.decode(model, place, pair, levels, pilots, subject, stages, monitor, sure=sure)
            found = plane.user_data(model, page, stages, monitor) if user_data else None
            seen.note(page=page, user_data=found)
        plane.took(model, time.perf_counter() - began, page.timings)
    return plane.answer(page, model, stages, found, monitor)


def decode_reply(
    answer: Answer, options: pb.DecodeOptions, correlation_id: str, frame_id: int = 0, captured_s: float = 0.0
) -> pb.DecodeReply:
    """Return an answer as its message, for `options` that have been checked, with what is the caller's own."""
    page, confidence = answer.page, answer.page.confidence
    rows, columns = page.symbols.shape
    coarse = options.confidence_format == pb.CONFIDENCE_FORMAT_UINT8
    return message_of(
        pb.DecodeReply,
        answer,
        page,
        page.check,
        rows=rows,
        columns=columns,
        confidence=np.floor(confidence * 255).astype(np.uint8) if coarse else confidence,
        confidence_format=options.confidence_format or pb.CONFIDENCE_FORMAT_FLOAT32,
        concentration=page.concentration if options.want_concentration else None,
        phase=page.phase if options.want_phase else None,
        level_phases=page.level_phases if options.want_phase else None,
        recalibration_reasons=_recalibration_reasons(answer),
        user_data=None if answer.user_data is None else user_data_message(answer.user_data),
        timings=message_of(
            pb.Timings,
            answer,
            decode_s=page.timings.worked_s,
            inference_s=page.timings.inference_s,
            steps=page.timings.steps,
            skipped_steps=page.timings.skipped_steps,
        ),
        correlation_id=correlation_id,
        frame_id=frame_id,
        captured_s=captured_s,
    )


_SIGNS = {
    signs.MARGIN.name: pb.RECALIBRATION_REASON_MARGIN,
    signs.AIR.name: pb.RECALIBRATION_REASON_INFORMATION,
    signs.TRUST.name: pb.RECALIBRATION_REASON_TRUST,
    signs.SHARE.name: pb.RECALIBRATION_REASON_PILOT_SHARE,
    signs.CHANGED.name: pb.RECALIBRATION_REASON_PAGES,
    signs.UNREAD.name: pb.RECALIBRATION_REASON_UNREAD,
    signs.RESIDUAL.name: pb.RECALIBRATION_REASON_RESIDUAL,
    signs.SHIFT.name: pb.RECALIBRATION_REASON_SHIFT,
    signs.STROKE.name: pb.RECALIBRATION_REASON_STROKE,
    signs.PISTON_WALK.name: pb.RECALIBRATION_REASON_PISTON,
}


def _recalibration_reasons(answer: Answer) -> list[pb.RecalibrationReason]:
    own = [pb.RECALIBRATION_REASON_PAGE] if answer.page.check.recalibration_due else []
    return own + [_SIGNS.get(name, pb.RECALIBRATION_REASON_OTHER) for name in answer.monitor_signs]


def user_data_message(found: PageBytes) -> pb.UserData:
    """Return what a page gave as its message."""
    file = found.file or FileFacts(0, 0, 0)
    return message_of(pb.UserData, found, file, file_checksum=file.checksum)
