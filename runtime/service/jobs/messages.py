"""Recalibrations as messages."""

from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.wire.messages import message_of
from lightpage.runtime.recalibration.recalibration import RecalibrationOutcome


def result_message(outcome: RecalibrationOutcome) -> pb.RecalibrationResult:
    """Return a recalibration's outcome as its message."""
    report = outcome.report
    judged = {name: getattr(report.goodness, name, None) for name in ("verdict", "bits_lost", "cause")}
    return message_of(pb.RecalibrationResult, outcome, report, model_version=outcome.version, **judged)
