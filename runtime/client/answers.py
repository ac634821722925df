"""What a service says of itself and of a recalibration."""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from lightpage.codec.page_bytes import PageBytes
from lightpage.errors import LightpageError
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.wire.messages import image_of, user_data_of
from lightpage.runtime.client.wire.status import error_from
from lightpage.runtime.model.decoding.image_position import ImagePosition


@dataclass(frozen=True)
class ModelInfo:
    """A model that the service has.

    Attributes:
        name, version, created, metrics: as its bundle says.
        current: whether it decodes now.
        pinned: whether it is never deleted.
        loaded: whether it is loaded.
        origin: "given", "recalibrated" or "uploaded"; empty where that is not known.
    """

    name: str
    version: str
    created: str
    current: bool
    metrics: dict[str, float]
    pinned: bool = False
    loaded: bool = True
    origin: str = ""


@dataclass(frozen=True)
class ServiceLimits:
    """How much a service takes.

    Attributes:
        message_bytes, chunk_bytes, pair_bytes: largest message, chunk of frames, and pair of frames.
        concurrent_decodes: pages decoded at the same time; more wait.
        replay_s, replay_bytes: how long, and how many bytes of, the answers of request ids are kept.
        recalibration_pages: of one recalibration.
        model_bytes: of an uploaded bundle.
        range_pages: that are read in one call.
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


def limits_of(message: pb.Limits) -> ServiceLimits:
    """Limits from their message."""
    return ServiceLimits(**{field.name: getattr(message, field.name) for field in fields(ServiceLimits)})


@dataclass(frozen=True)
class Description:
    """What a service is."""

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
    code_toml: str = ""
    """How user bytes are protected on this device's pages; empty where the model has no code."""
    user_bytes_per_page: int = 0
    default_levels: int = 0
    """What `levels` 0 stands for where no user bytes are asked for."""
    limits: ServiceLimits | None = None


@dataclass(frozen=True)
class RemoteData:
    """The bytes of a page of the source.

    Attributes:
        page: number in the source; None where the bytes were restored from other pages of the group.
        user_data: what the page gave; its header says which page of which volume it is.
        error: why it was not decoded, for people; empty where it was.
    """

    page: int | None
    user_data: PageBytes
    error: str = ""


def remote_data(reply: pb.ReadDataReply) -> RemoteData:
    """A message as a page's bytes."""
    told = reply.error
    error = f"{told.thing}: got {told.got}, wanted {told.wanted}" if reply.HasField("error") else ""
    return RemoteData(None if reply.restored else reply.page, user_data_of(reply.user_data), error)


@dataclass(frozen=True)
class Recalibrated:
    """The result of a recalibration: AIR in bits per symbol on held-back pages; None where the fit does not say.

    `air_limit` is the least `air_after` that would have been accepted, `air_standard_error` that of the difference;
    None from a service of an earlier version.
    """

    model_version: str
    previous_version: str
    pages_used: int
    pages_held_back: int
    air_before: float
    air_after: float
    angle_deg: float | None
    coherence_before: float | None
    coherence_after: float | None
    seconds: float
    pages_lost_before: int = 0
    image: ImagePosition | None = None
    air_limit: float | None = None
    air_standard_error: float | None = None


_ORIGINS = {
    pb.MODEL_ORIGIN_GIVEN: "given",
    pb.MODEL_ORIGIN_RECALIBRATED: "recalibrated",
    pb.MODEL_ORIGIN_UPLOADED: "uploaded",
}


def model_info(model: pb.Model) -> ModelInfo:
    """A model from its message."""
    return ModelInfo(
        name=model.name,
        version=model.version,
        created=model.created,
        current=model.current,
        metrics=dict(model.metrics),
        pinned=model.pinned,
        loaded=model.loaded,
        origin=_ORIGINS.get(model.origin, ""),
    )


def recalibrated(result: pb.RecalibrationResult) -> Recalibrated:
    """A recalibration from its message."""

    def optional(name: str) -> float | None:
        return float(getattr(result, name)) if result.HasField(name) else None

    return Recalibrated(
        model_version=result.model_version,
        previous_version=result.previous_version,
        pages_used=result.pages_used,
        pages_held_back=result.pages_held_back,
        air_before=result.air_before,
        air_after=result.air_after,
        angle_deg=optional("angle_deg"),
        coherence_before=optional("coherence_before"),
        coherence_after=optional("coherence_after"),
        seconds=result.seconds,
        pages_lost_before=result.pages_lost_before,
        image=image_of(result.image) if result.HasField("image") else None,
        air_limit=optional("air_limit"),
        air_standard_error=optional("air_standard_error"),
    )


class JobState(StrEnum):
    """How a job stands."""

    RUNNING = "RUNNING"
    DONE = "DONE"
    REFUSED = "REFUSED"
    """The new model would not be better; the old one stays."""
    FAILED = "FAILED"
    CANCELLED = "CANCELLED"
    INTERRUPTED = "INTERRUPTED"
    """The service ended while it ran; nothing was changed."""
    UNKNOWN = "UNKNOWN"
    """Of a service that is newer than this client."""


@dataclass(frozen=True)
class JobInfo:
    """A recalibration as a job of the service.

    Attributes:
        id: by which the service knows it.
        state: how it stands.
        step, fraction: what is, or was last, being done, and how far all of it is, 0..1.
        created_s: when it began, seconds since 1970.
        pages_of: where its pages came from, for people.
        ended_s: when it ended, None while it runs.
        result: of a job that is done.
        error: why one that has ended is not done.
        correlation_id: the text of whoever started it.
    """

    id: str
    state: JobState
    step: str
    fraction: float
    created_s: float
    pages_of: str
    ended_s: float | None = None
    result: Recalibrated | None = None
    error: LightpageError | None = None
    correlation_id: str = ""


def job_info(job: pb.Job) -> JobInfo:
    """A job from its message."""
    name = pb.JobState.Name(job.state).removeprefix("JOB_STATE_") if job.state in pb.JobState.values() else ""
    return JobInfo(
        id=job.id,
        state=JobState[name] if name in JobState.__members__ else JobState.UNKNOWN,
        step=job.progress.step,
        fraction=job.progress.fraction,
        created_s=job.created_s,
        pages_of=job.pages_of,
        ended_s=job.ended_s or None,
        result=recalibrated(job.result) if job.HasField("result") else None,
        error=error_from(job.refusal.detail) if job.HasField("refusal") else None,
        correlation_id=job.correlation_id,
    )


@dataclass(frozen=True)
class DisplayOrder:
    """What a controller is to show.

    Attributes:
        page: number of the page that the service waits for, None where it waits for none.
        beams: (signal, reference) that are to be let through, None where it does not wait for them.
    """

    page: int | None
    beams: tuple[bool, bool] | None


def display_order(reply: pb.WatchDisplayReply) -> DisplayOrder:
    """An order from its message."""
    return DisplayOrder(
        reply.page if reply.HasField("page") else None,
        (reply.beams.signal, reply.beams.reference) if reply.HasField("beams") else None,
    )
