"""Answers of a service, as its callers see them."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from lightpage.codec.page_bytes import FileFacts, Header, Loss, PageBytes
from lightpage.errors import LightpageError
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.wire.messages import PIXEL_TYPES, answer_of, array_of, member_of
from lightpage.runtime.client.wire.status import error_from
from lightpage.runtime.model.decoding.image_position import ImagePosition
from lightpage.words import brief, sides


@dataclass(frozen=True)
class RemoteTimings:
    """Seconds spent in the service, and the page's Gauss-Newton steps.

    Attributes:
        receive_s: from the beginning of the call until the frames were there; or reading from the source.
        decode_s: all attempts at the page.
        inference_s: all inferences, a part of `decode_s`.
        total_s: everything, waiting for a free slot included.
        steps: number of Gauss-Newton steps of all inferences; 0 for a network's bundle, and from services before 0.2.
        skipped_steps: number of steps that these inferences lack, since the caller's time was short.
    """

    receive_s: float
    decode_s: float
    inference_s: float
    total_s: float
    steps: int = 0
    skipped_steps: int = 0


@dataclass(frozen=True)
class RemoteFrame:
    """A camera's facts of a frame.

    Attributes:
        serial: serial of the camera.
        frame_id: number by the camera's own count, which wraps.
        device_time_s: time by the camera's clock, from any moment.
        host_time_s: time when the frame was complete, seconds since 1970.
    """

    serial: str
    frame_id: int
    device_time_s: float
    host_time_s: float


@dataclass(frozen=True, repr=False)
class RemotePage:
    """A page that a service decoded.

    Attributes:
        symbols: uint8 [ny, nx], 0..levels-1.
        confidence: float32 [ny, nx], posterior of each symbol; in steps of 1/255 where quantised.
        concentration: float32 [ny, nx], or None where not asked for.
        phase: float32 [ny, nx], radians, piston removed, or None where not asked for.
        levels: level count M.
        level_phases: phase that stands for each level, radians; None where level s is 2 pi s / M, or no phase was asked
            for.
        piston_rad: piston that was removed.
        pilot_coherence: agreement of the pilots, 0..1.
        pilot_trust: share of the claimed concentration that pilots bear out, 0..1; the fields above include it.
        claimed_bits, confirmed_bits: information per pilot that is claimed, and that the pilots confirm.
        recalibration_due: whether they confirm less than on a device that is as it was calibrated.
        image: position of the image, or None where the service does not follow it.
        model_version: version of the model that decoded it.
        timings: seconds in the service, and Gauss-Newton steps.
        page: number of the page in the source, or None where the caller sent the frames.
        written: symbols that were written, uint8 [ny, nx], or None where the source does not know them.
        pilot_mask: places of the pilots, bool [ny, nx]; given with `written`.
        user_data: the page's bytes, or None where not asked for.
        recalibration_reasons: reasons why a recalibration is due, by the contract's names without prefix.
        frame_id, captured_s, correlation_id: values that the caller gave.
        frames: frames of the in-phase and the quadrature camera; empty where the source has none.
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
    level_phases: tuple[float, ...] | None = None

    def __repr__(self) -> str:
        number = [] if self.page is None else [f"number {self.page}"]
        symbols = f"{sides(self.symbols.shape)} symbols of {self.levels} levels"
        return brief(self, *number, symbols, f"confidence {self.confidence.mean():.3f}", f"by {self.model_version}")


def remote_page(reply: pb.DecodeReply, read: pb.ReadPageReply | None = None) -> RemotePage:
    """Return a reply as arrays.

    Raises:
        LightpageError: arrays whose sizes contradict the reply's own shape.
    """
    shape, given = (reply.rows, reply.columns), dict[str, object]()
    if reply.confidence_format == pb.CONFIDENCE_FORMAT_UINT8:
        octets = array_of(reply.confidence, np.dtype(np.uint8), shape, "confidence")
        given["confidence"] = octets / np.float32(255)
    if read is not None:
        given["page"] = read.page  # 0 is a page like any other
    user_data = page_bytes(reply.user_data) if reply.HasField("user_data") else None
    messages = (reply,) if read is None else (reply, read)
    return answer_of(RemotePage, *messages, shape=shape, user_data=user_data, **given)


class ModelOrigin(StrEnum):
    """Origin of a model."""

    GIVEN = "given"
    RECALIBRATED = "recalibrated"
    UPLOADED = "uploaded"
    UNKNOWN = ""


@dataclass(frozen=True)
class ModelInfo:
    """A model that the service has.

    Attributes:
        name, version, created, metrics: values of the bundle's manifest.
        current: whether it decodes now.
        pinned: whether it is never deleted.
        loaded: whether it is loaded.
        origin: origin of the model.
    """

    name: str
    version: str
    created: str
    current: bool
    metrics: dict[str, float]
    pinned: bool
    loaded: bool
    origin: ModelOrigin


@dataclass(frozen=True)
class ServiceLimits:
    """Limits of a service.

    Attributes:
        message_bytes, chunk_bytes, pair_bytes: largest message, chunk of frames, and pair of frames.
        concurrent_decodes: pages decoded at the same time; more wait.
        replay_s, replay_bytes: time and bytes for which answers of request ids are kept.
        recalibration_pages: number of pages of one recalibration.
        model_bytes: largest size of an uploaded bundle.
        range_pages: number of pages that are read in one call.
        shared_bytes: memory that clients may share with it, 0 for none.
    """

    message_bytes: int
    chunk_bytes: int
    pair_bytes: int
    concurrent_decodes: int
    replay_s: float
    replay_bytes: int
    recalibration_pages: int
    model_bytes: int
    range_pages: int
    shared_bytes: int


@dataclass(frozen=True, repr=False)
class Description:
    """Description of a service."""

    service_version: str
    model: ModelInfo
    frame_shape: tuple[int, int]
    frame_dtype: str
    bit_depth: int
    page_shape: tuple[int, int]
    source: str
    source_levels: int
    profile_toml: str
    calibration_toml: str
    pilot_mask: NDArray[np.bool_]
    pilot_phases: NDArray[np.float32] | None
    """Radians, one a True of `pilot_mask` in row order; None for the profile's pattern."""
    code_toml: str
    """Code of user bytes, TOML; empty where the model has none."""
    user_bytes_per_page: int
    default_levels: int
    """Level count that `levels` 0 stands for where no user bytes are asked for."""
    steps_s: tuple[float, ...]
    """Usual time of a page's inference with 1, 2, ... Gauss-Newton steps, seconds; empty for a network."""
    limits: ServiceLimits

    def __repr__(self) -> str:
        page, frame = f"pages of {sides(self.page_shape)} symbols", f"frames of {sides(self.frame_shape)} pixels"
        source = self.source or "no source"
        return brief(self, f"service {self.service_version}", f"model {self.model.version}", source, page, frame)


def description(reply: pb.DescribeReply) -> Description:
    """Return what a service is."""
    camera, shape = reply.camera, (reply.page.rows, reply.page.columns)
    return answer_of(
        Description,
        reply,
        camera,
        shape=shape,
        frame_shape=(camera.rows_px, camera.columns_px),
        frame_dtype=PIXEL_TYPES.get(camera.pixel_type, "unknown"),
        page_shape=shape,
    )


@dataclass(frozen=True)
class RemoteData:
    """The bytes of a page of the source.

    Attributes:
        page: number in the source; None where the bytes were restored from other pages of the group.
        user_data: bytes of the page; its header says which page of which volume it is.
        error: reason why it was not decoded, for people; empty where it was.
    """

    page: int | None
    user_data: PageBytes
    error: str = ""


def remote_data(reply: pb.ReadDataReply) -> RemoteData:
    """Return a page's bytes, or why there are none."""
    told = reply.error
    error = str(LightpageError(told.thing, told.got, told.wanted)) if reply.HasField("error") else ""
    return RemoteData(None if reply.restored else reply.page, page_bytes(reply.user_data), error)


@dataclass(frozen=True)
class Recalibrated:
    """The result of a recalibration: AIR in bits per symbol on held-back pages; None where the fit, or an earlier
    service, does not say.

    `air_limit` is the least `air_after` that would have been accepted, `air_standard_error` that of the difference.
    `rounds` are those of a healing, None where pages were known. `verdict`, `bits_lost` and `cause` say how well the
    geometry explains the light.
    """

    model_version: str
    previous_version: str
    angle_deg: float | None
    pages_used: int
    pages_held_back: int
    seconds: float
    coherence_before: float | None
    coherence_after: float | None
    air_before: float
    air_after: float
    air_limit: float | None
    air_standard_error: float | None
    pages_lost_before: int
    image: ImagePosition | None
    rounds: int | None = None
    verdict: str | None = None
    bits_lost: float | None = None
    cause: str | None = None

    @property
    def told(self) -> str:
        """Return which model took over, whether it was healed, and how good its fit is, for people."""
        healed = "" if self.rounds is None else f", healed in {self.rounds} rounds"
        fit = "" if self.verdict is None else f", a {self.verdict} fit"
        return f"{self.model_version} in service instead of {self.previous_version}{healed}{fit}"


class JobState(StrEnum):
    """State of a job."""

    RUNNING = "RUNNING"
    DONE = "DONE"
    REFUSED = "REFUSED"
    """The new model would not be better; the old one stays."""
    FAILED = "FAILED"
    CANCELLED = "CANCELLED"
    INTERRUPTED = "INTERRUPTED"
    """The service ended while it ran; nothing was changed."""
    UNKNOWN = "UNKNOWN"
    """State of a service that is newer than this client."""


@dataclass(frozen=True)
class JobInfo:
    """A recalibration as a job of the service.

    Attributes:
        id: name of the job in the service.
        state: state of the job.
        step, fraction: step that runs or ran last, and share of the whole that is done, 0..1.
        created_s: time of the start, seconds since 1970.
        pages_of: origin of its pages, for people.
        ended_s: time of the end, None while it runs.
        result: result of a job that is done.
        error: error that it ended with, None without one.
        correlation_id: text of the caller who started it.
    """

    id: str
    state: JobState
    step: str
    fraction: float
    created_s: float
    pages_of: str
    ended_s: float | None
    result: Recalibrated | None
    error: LightpageError | None
    correlation_id: str


def job_info(job: pb.Job) -> JobInfo:
    """Return how a job stands."""
    error = error_from(job.refusal.detail) if job.HasField("refusal") else None
    return answer_of(JobInfo, job, job.progress, error=error)


@dataclass(frozen=True)
class DisplayOrder:
    """Order to a controller: the page to show, or the beams to set.

    Attributes:
        page: number of the page that the service waits for, None where it waits for none.
        beams: (signal, reference) that are to be let through, None where it does not wait for them.
    """

    page: int | None
    beams: tuple[bool, bool] | None


def display_order(reply: pb.WatchDisplayReply) -> DisplayOrder:
    """Return what is to be shown."""
    beams = (reply.beams.signal, reply.beams.reference) if reply.HasField("beams") else None
    return answer_of(DisplayOrder, reply, beams=beams)


def page_bytes(told: pb.UserData) -> PageBytes:
    """Return what a page gave; a loss that this version does not know counts as one of the body."""
    loss = member_of(Loss, pb.DataLoss.DESCRIPTOR, told.loss, Loss.BODY) if told.loss else None
    return answer_of(
        PageBytes,
        told,
        header=answer_of(Header, told.header) if told.HasField("header") else None,
        data=told.data if loss is None else None,
        file=FileFacts(told.data_pages, told.parity_pages, told.file_checksum) if loss is None else None,
        loss=loss,
    )
