"""A page as a caller of the service sees it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.codec.page_bytes import PageBytes
from lightpage.errors import LightpageError
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.wire.messages import FLOAT, image_of, user_data_of
from lightpage.runtime.model.decoding.image_position import ImagePosition


@dataclass(frozen=True)
class RemoteTimings:
    """Seconds spent in the service."""

    receive_s: float
    decode_s: float
    inference_s: float
    total_s: float


@dataclass(frozen=True)
class RemoteFrame:
    """What a camera says of a frame.

    Attributes:
        serial: of the camera.
        frame_id: its own count, which wraps.
        device_time_s: by its clock, from any moment.
        host_time_s: when the frame was complete, seconds since 1970.
    """

    serial: str
    frame_id: int
    device_time_s: float
    host_time_s: float


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
        user_data: the page's bytes, or None where not asked for.
        recalibration_reasons: why a recalibration is due, as the contract names it without prefix.
        frame_id, captured_s, correlation_id: as the caller gave them.
        frames: of the in-phase and the quadrature camera; empty where the source has none.
        replayed: whether this is the answer to an earlier call with the same request id.
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
    user_data: PageBytes | None = None
    recalibration_reasons: tuple[str, ...] = ()
    frame_id: int = 0
    captured_s: float = 0.0
    correlation_id: str = ""
    frames: tuple[RemoteFrame, ...] = ()
    replayed: bool = False


def remote_page(reply: pb.DecodeReply, read: pb.ReadPageReply | None = None) -> RemotePage:
    """A reply as arrays.

    Raises:
        LightpageError: arrays whose sizes contradict the reply's own shape.
    """
    shape = (reply.rows, reply.columns)
    if reply.confidence_format == pb.CONFIDENCE_FORMAT_UINT8:
        confidence = _array(reply.confidence, np.dtype(np.uint8), shape, "confidence") / np.float32(255)
    else:
        confidence = _array(reply.confidence, FLOAT, shape, "confidence")
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
        user_data=user_data_of(reply.user_data) if reply.HasField("user_data") else None,
        model_version=reply.model_version,
        timings=RemoteTimings(
            reply.timings.receive_s, reply.timings.decode_s, reply.timings.inference_s, reply.timings.total_s
        ),
        page=read.page if read is not None else None,
        written=_array(written, np.dtype(np.uint8), shape, "written") if written else None,
        pilot_mask=_array(read.pilot_mask, np.dtype(np.uint8), shape, "pilot_mask") != 0 if read and written else None,
        recalibration_reasons=tuple(map(_reason_name, reply.recalibration_reasons)),
        frame_id=reply.frame_id,
        captured_s=reply.captured_s,
        correlation_id=reply.correlation_id,
        frames=() if read is None else tuple(map(_frame, read.frames)),
        replayed=read is not None and read.replayed,
    )


def _frame(frame: pb.CameraFrame) -> RemoteFrame:
    return RemoteFrame(frame.serial, frame.frame_id, frame.device_time_s, frame.host_time_s)


def _reason_name(reason: pb.RecalibrationReason) -> str:
    """The name of a reason, "OTHER" of one that this version does not know."""
    known = reason in pb.RecalibrationReason.values()
    return pb.RecalibrationReason.Name(reason).removeprefix("RECALIBRATION_REASON_") if known else "OTHER"


def _optional(data: bytes, shape: tuple[int, int], name: str) -> NDArray[np.float32] | None:
    return _array(data, FLOAT, shape, name).astype(np.float32, copy=False) if data else None


def _array(data: bytes, dtype: np.dtype[Any], shape: tuple[int, int], name: str) -> NDArray[Any]:
    if len(data) != shape[0] * shape[1] * dtype.itemsize:
        raise LightpageError(f"reply: {name}", f"{len(data)} bytes", f"{shape[0]}x{shape[1]} of {dtype}")
    return np.frombuffer(data, dtype).reshape(shape)
