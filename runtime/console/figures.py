"""Figures of a running service between two scrapes of its metrics: for a terminal, and as JSON."""

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass

from lightpage.runtime.console.scrapes import Change
from lightpage.runtime.service.stages import Stage


@dataclass(frozen=True)
class Load:
    """Pages and calls; what was lost or rejected is counted by its reason."""

    pages_per_s: float
    pages_lost: Mapping[str, float]
    calls_per_s: Mapping[str, float]
    rejects: Mapping[str, float]
    decodes_waiting: float
    decodes_busy: float
    decodes_slots: float
    frames_bytes: float
    frames_limit_bytes: float
    received_bytes_per_s: float


@dataclass(frozen=True)
class DeviceSigns:
    """Signs of the device's state. No user data read gives no margin; `source_ok` and `store_trouble` are of now."""

    margin_bits: float
    pilot_trust: float
    air_share: float
    air_bits: float
    image_shift_x_px: float
    image_shift_y_px: float
    recalibration_due: bool
    signs_raised: tuple[str, ...]
    recalibrations: Mapping[str, float]
    source_ok: bool
    store_ok: bool
    store_trouble: tuple[str, ...]


@dataclass(frozen=True)
class Process:
    """Process of the service."""

    cpu_cores: float
    memory_bytes: float
    descriptors: float
    descriptors_limit: float
    calls_in_flight: float


@dataclass(frozen=True)
class StageTimes:
    """Times of one stage of a page; `share` is that of all stages' time."""

    stage: str
    pages: float
    share: float
    mean_s: float
    p50_s: float
    p99_s: float


@dataclass(frozen=True)
class ServiceFigures:
    """Figures of a service; NaN where it says nothing.

    Attributes:
        model_version: version of the model in service.
        up_s: seconds since it started.
        seconds: between the scrapes, which all rates are means over.
        restarts: number of restarts of the service, since it has been scraped.
    """

    model_version: str
    up_s: float
    seconds: float
    restarts: int
    load: Load
    device: DeviceSigns
    process: Process
    stages: tuple[StageTimes, ...]


def service_figures(change: Change, restarts: int = 0) -> ServiceFigures:
    """Return what two scrapes say."""
    now = change.now
    return ServiceFigures(
        model_version=next((dict(own)["version"] for own in now.values("lightpage_model_info")), "none"),
        up_s=max(0.0, up_s) if math.isfinite(up_s := time.time() - now.value("process_start_time_seconds")) else up_s,
        seconds=change.seconds,
        restarts=restarts,
        load=_load(change),
        device=_device(change),
        process=Process(
            cpu_cores=change.rate("process_cpu_seconds_total"),
            memory_bytes=now.value("process_resident_memory_bytes"),
            descriptors=now.value("process_open_fds"),
            descriptors_limit=now.value("process_max_fds"),
            calls_in_flight=now.value("lightpage_calls_in_flight"),
        ),
        stages=tuple(_stage(change, stage.value) for stage in Stage),
    )


def _load(change: Change) -> Load:
    now, calls = change.now, change.rises("lightpage_calls_total", "code")
    return Load(
        pages_per_s=change.rate("lightpage_pages_total"),
        pages_lost=change.rises("lightpage_pages_lost_total", "reason"),
        calls_per_s={code: count / change.seconds if change.seconds > 0 else math.nan for code, count in calls.items()},
        rejects=change.rises("lightpage_rejects_total", "reason"),
        decodes_waiting=now.value("lightpage_decodes_waiting"),
        decodes_busy=now.value("lightpage_decodes_busy"),
        decodes_slots=now.value("lightpage_decodes_slots"),
        frames_bytes=now.value("lightpage_receive_buffer_bytes"),
        frames_limit_bytes=now.value("lightpage_receive_buffer_limit_bytes"),
        received_bytes_per_s=change.rate("lightpage_received_bytes_total"),
    )


def _device(change: Change) -> DeviceSigns:
    now = change.now

    def raised(name: str, label: str) -> tuple[str, ...]:
        return tuple(dict(own)[label] for own, value in now.values(name).items() if value == 1)

    read = now.value("lightpage_data_pages_total", loss="none") > 0
    recalibrations = now.values("lightpage_recalibrations_total")
    return DeviceSigns(
        margin_bits=now.value("lightpage_margin_bits") if read else math.nan,
        pilot_trust=now.value("lightpage_pilot_trust") or math.nan,
        air_share=now.value("lightpage_pilot_share") or math.nan,
        air_bits=now.value("lightpage_monitor_sign", sign="air_bits"),
        image_shift_x_px=now.value("lightpage_image_shift_px", axis="x"),
        image_shift_y_px=now.value("lightpage_image_shift_px", axis="y"),
        recalibration_due=now.value("lightpage_monitor_due") == 1,
        signs_raised=raised("lightpage_monitor_sign_raised", "sign"),
        recalibrations={dict(own)["result"]: count for own, count in recalibrations.items() if count},
        source_ok=now.value("lightpage_source_ok") != 0,
        store_ok=now.value("lightpage_store_ok") != 0,
        store_trouble=raised("lightpage_store_trouble", "reason"),
    )


def _stage(change: Change, stage: str) -> StageTimes:
    name = "lightpage_stage_seconds"
    whole = change.rise(f"{name}_sum")
    return StageTimes(
        stage=stage,
        pages=change.rise(f"{name}_count", stage=stage),
        share=change.rise(f"{name}_sum", stage=stage) / whole if whole > 0 else math.nan,
        mean_s=change.mean(name, stage=stage),
        p50_s=change.quantile(0.5, name, stage=stage),
        p99_s=change.quantile(0.99, name, stage=stage),
    )
