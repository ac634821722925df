"""Recalibrations as messages."""

from __future__ import annotations

from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.recalibration.recalibration import RecalibrationOutcome
from lightpage.runtime.service.frames.frames import image_message


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
        air_limit=outcome.air_limit,
        air_standard_error=outcome.air_standard_error,
    )
