"""Between protobuf messages and the runtime's own objects; nothing else knows both."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import InvalidInputError, LightpageError, PageError
from lightpage.page.pilots import Pilots
from lightpage.page.symbols import MAX_LEVELS, check_levels, symbol_phases
from runtime.decoding.decoder import ImagePosition
from runtime.pb.lightpage.v1 import lightpage_pb2 as pb
from runtime.recalibration.recalibration import RecalibrationOutcome
from runtime.service.dataplane import Answer, ReadAnswer
from runtime.service.registry import Model

PIXEL_TYPES = {pb.PIXEL_TYPE_UINT8: "uint8", pb.PIXEL_TYPE_UINT16: "uint16"}
PIXEL_CODES = {name: code for code, name in PIXEL_TYPES.items()}

_CONFIDENCE_FORMATS = (pb.CONFIDENCE_FORMAT_UNSPECIFIED, pb.CONFIDENCE_FORMAT_FLOAT32, pb.CONFIDENCE_FORMAT_UINT8)
_FLOAT = np.dtype("<f4")


def pixel_type(code: pb.PixelType) -> str:
    """numpy's name of a pixel type.

    Raises:
        InvalidInputError: unspecified or unknown.
    """
    if code not in PIXEL_TYPES:
        raise InvalidInputError("pixel_type", code, "PIXEL_TYPE_UINT8 or PIXEL_TYPE_UINT16")
    return PIXEL_TYPES[code]


def pilots_of(message: pb.Pilots, page_shape: tuple[int, int], levels: int) -> Pilots:
    """Pilots that a caller sent.

    Raises:
        PageError: sizes that do not fit the page, or levels out of range.
    """
    flags = np.frombuffer(message.mask, np.uint8)
    values = np.frombuffer(message.values, np.uint8)
    if flags.size != page_shape[0] * page_shape[1] or np.count_nonzero(flags) != values.size:
        got = f"{flags.size} flags, {np.count_nonzero(flags)} of them set, and {values.size} values"
        raise PageError("pilots", got, f"{page_shape[0] * page_shape[1]} flags and one value a set flag")
    levels = message.levels or levels
    if values.size and int(values.max()) >= levels:
        raise PageError("pilots", f"level {values.max()}", f"0..{levels - 1}")
    return Pilots(flags.reshape(page_shape) != 0, symbol_phases(values, levels))


@dataclass(frozen=True)
class KnownPilots:
    """Pilots that a caller knows: bool mask [ny, nx], a page of symbols [ny, nx], and their level count."""

    mask: NDArray[np.bool_]
    symbols: NDArray[np.uint8]
    levels: int


def pilots_message(pilots: KnownPilots) -> pb.Pilots:
    """Pilots as their message.

    Raises:
        PageError: mask and page differ in shape.
    """
    if pilots.mask.shape != pilots.symbols.shape:
        raise PageError("pilots", f"mask {pilots.mask.shape}, page {pilots.symbols.shape}", "two equal shapes")
    values = pilots.symbols[pilots.mask].tobytes()
    return pb.Pilots(mask=pilots.mask.astype(np.uint8).tobytes(), values=values, levels=pilots.levels)


def check_options(options: pb.DecodeOptions) -> None:
    """Check what a caller asks for, before a frame is received or a page is read for it.

    Raises:
        PageError: an impossible level count; 0 stands for the default.
        InvalidInputError: an unknown format of confidences.
    """
    if options.levels:
        check_levels(options.levels)
    if options.confidence_format not in _CONFIDENCE_FORMATS:
        wanted = "CONFIDENCE_FORMAT_FLOAT32 or CONFIDENCE_FORMAT_UINT8"
        raise InvalidInputError("confidence_format", options.confidence_format, wanted)


def levels_of(options: pb.DecodeOptions) -> int:
    """The level count asked for, 256 by default."""
    return options.levels or MAX_LEVELS


def decode_reply(answer: Answer, options: pb.DecodeOptions) -> pb.DecodeReply:
    """An answer as its message, for `options` that have been checked."""
    page = answer.page
    rows, columns = page.symbols.shape
    return pb.DecodeReply(
        rows=rows,
        columns=columns,
        levels=page.levels,
        symbols=page.symbols.tobytes(),
        confidence=_confidence_bytes(page.confidence, options.confidence_format),
        confidence_format=options.confidence_format or pb.CONFIDENCE_FORMAT_FLOAT32,
        concentration=page.concentration.astype(_FLOAT).tobytes() if options.want_concentration else b"",
        phase=page.phase.astype(_FLOAT).tobytes() if options.want_phase else b"",
        piston_rad=page.piston_rad,
        pilot_coherence=page.pilot_coherence,
        pilot_trust=page.pilot_trust,
        claimed_bits=page.check.claimed_bits,
        confirmed_bits=page.check.confirmed_bits,
        recalibration_due=page.check.recalibration_due,
        image=None if page.image is None else image_message(page.image),
        model_version=answer.model_version,
        timings=pb.Timings(
            receive_s=answer.receive_s,
            decode_s=page.timings.total_s,
            inference_s=page.timings.inference_s,
            total_s=answer.total_s,
        ),
    )


def image_message(image: ImagePosition) -> pb.ImagePosition:
    """An image's position as its message."""
    return pb.ImagePosition(**asdict(image))


def image_of(message: pb.ImagePosition) -> ImagePosition:
    """A message as an image's position."""
    return ImagePosition(**{field.name: getattr(message, field.name) for field in fields(ImagePosition)})


def _confidence_bytes(confidence: NDArray[np.float32], code: int) -> bytes:
    if code == pb.CONFIDENCE_FORMAT_UINT8:
        return np.floor(confidence * 255).astype(np.uint8).tobytes()
    return confidence.astype(_FLOAT).tobytes()


def read_reply(read: ReadAnswer, request: pb.ReadPageRequest) -> pb.ReadPageReply:
    """A page read from the source as its message."""
    written = read.source_page.symbols if request.want_written else None
    return pb.ReadPageReply(
        decoded=decode_reply(read.answer, request.options),
        page=read.source_page.page_index,
        written=b"" if written is None else written.tobytes(),
        pilot_mask=b"" if written is None else read.pilot_mask.astype(np.uint8).tobytes(),
    )


def model_message(model: Model, current: bool) -> pb.Model:
    """A model as its message; metrics that are no numbers stay behind."""
    manifest = model.decoder.bundle.manifest
    numbers = {k: float(v) for k, v in manifest.metrics.items() if isinstance(v, int | float)}
    return pb.Model(
        name=manifest.name, version=manifest.version, created=manifest.created, current=current, metrics=numbers
    )


def result_message(outcome: RecalibrationOutcome) -> pb.RecalibrationResult:
    """A recalibration's outcome as its message."""
    return pb.RecalibrationResult(
        model_version=outcome.version,
        previous_version=outcome.previous_version,
        pages_used=outcome.pages_used,
        pages_held_back=outcome.pages_held_back,
        air_before=outcome.air_before,
        air_after=outcome.air_after,
        angle_deg=outcome.report.angle_deg,
        coherence_before=outcome.report.coherence_before,
        coherence_after=outcome.report.coherence_after,
        seconds=outcome.seconds,
        pages_lost_before=outcome.pages_lost_before,
        image=None if outcome.report.image is None else image_message(outcome.report.image),
    )


@dataclass(frozen=True)
class RemoteTimings:
    """Seconds spent in the service."""

    receive_s: float
    decode_s: float
    inference_s: float
    total_s: float


@dataclass(frozen=True)
class RemotePage:
    """A page that a service decoded.

    Attributes:
        symbols: uint8 [ny, nx], 0..levels-1.
        confidence: float32 [ny, nx], posterior of each symbol; in steps of 1/255 where quantised.
        concentration: float32 [ny, nx], or None where not asked for.
        phase: float32 [ny, nx], radians, piston removed, or None where not asked for.
        levels: M.
        piston_rad: what was removed.
        pilot_coherence: agreement of the pilots, 0..1.
        pilot_trust: share of the claimed concentration that they bear out, 0..1; in the fields above already.
        claimed_bits, confirmed_bits: information per pilot that is claimed, and that the pilots confirm.
        recalibration_due: whether they confirm less than on a device that is as it was calibrated.
        image: where the image lay, or None where the service does not follow it.
        model_version: which model decoded it.
        timings: seconds in the service.
        page: number of the page in the source, or None where the caller sent the frames.
        written: what the source knows to have been written, uint8 [ny, nx], or None.
        pilot_mask: where the pilots are, bool [ny, nx]; given with `written`.
    """

    symbols: NDArray[np.uint8]
    confidence: NDArray[np.float32]
    concentration: NDArray[np.float32] | None
    phase: NDArray[np.float32] | None
    levels: int
    piston_rad: float
    pilot_coherence: float
    model_version: str
    timings: RemoteTimings
    page: int | None = None
    written: NDArray[np.uint8] | None = None
    pilot_mask: NDArray[np.bool_] | None = None
    pilot_trust: float = 1.0
    claimed_bits: float = 0.0
    confirmed_bits: float = 0.0
    recalibration_due: bool = False
    image: ImagePosition | None = None


def remote_page(reply: pb.DecodeReply, read: pb.ReadPageReply | None = None) -> RemotePage:
    """A reply as arrays.

    Raises:
        LightpageError: arrays whose sizes contradict the reply's own shape.
    """
    shape = (reply.rows, reply.columns)
    if reply.confidence_format == pb.CONFIDENCE_FORMAT_UINT8:
        confidence = _array(reply.confidence, np.dtype(np.uint8), shape, "confidence") / np.float32(255)
    else:
        confidence = _array(reply.confidence, _FLOAT, shape, "confidence")
    written = read.written if read is not None else b""
    return RemotePage(
        symbols=_array(reply.symbols, np.dtype(np.uint8), shape, "symbols"),
        confidence=confidence.astype(np.float32, copy=False),
        concentration=_optional(reply.concentration, shape, "concentration"),
        phase=_optional(reply.phase, shape, "phase"),
        levels=reply.levels,
        piston_rad=reply.piston_rad,
        pilot_coherence=reply.pilot_coherence,
        pilot_trust=reply.pilot_trust,
        claimed_bits=reply.claimed_bits,
        confirmed_bits=reply.confirmed_bits,
        recalibration_due=reply.recalibration_due,
        image=image_of(reply.image) if reply.HasField("image") else None,
        model_version=reply.model_version,
        timings=RemoteTimings(
            reply.timings.receive_s, reply.timings.decode_s, reply.timings.inference_s, reply.timings.total_s
        ),
        page=read.page if read is not None else None,
        written=_array(written, np.dtype(np.uint8), shape, "written") if written else None,
        pilot_mask=_array(read.pilot_mask, np.dtype(np.uint8), shape, "pilot_mask") != 0 if read and written else None,
    )


def _optional(data: bytes, shape: tuple[int, int], name: str) -> NDArray[np.float32] | None:
    return _array(data, _FLOAT, shape, name).astype(np.float32, copy=False) if data else None


def _array(data: bytes, dtype: np.dtype[Any], shape: tuple[int, int], name: str) -> NDArray[Any]:
    if len(data) != shape[0] * shape[1] * dtype.itemsize:
        raise LightpageError(f"reply: {name}", f"{len(data)} bytes", f"{shape[0]}x{shape[1]} of {dtype}")
    return np.frombuffer(data, dtype).reshape(shape)
