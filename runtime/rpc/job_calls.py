"""Recalibration: Recalibrate."""

from __future__ import annotations

from collections.abc import Iterator

from lightpage.errors import InvalidInputError
from runtime.pb.lightpage.v1 import lightpage_pb2 as pb
from runtime.rpc.call import Call
from runtime.rpc.replies import result_message
from runtime.service.recalibrator import Recalibrator, Step


class JobCalls:
    """Handlers of the calls that recalibrate.

    Args:
        recalibrator: of the service.
    """

    def __init__(self, recalibrator: Recalibrator) -> None:
        self._recalibrator = recalibrator

    def Recalibrate(self, request: pb.RecalibrateRequest, call: Call) -> Iterator[pb.RecalibrateReply]:
        """Recalibrate and tell how it goes."""
        kind = request.WhichOneof("pages")
        if kind == "source":
            steps = self._recalibrator.from_source(request.source.count, list(request.source.pages), call.caller)
        elif kind == "recording":
            steps = self._recalibrator.from_recording(request.recording, request.recording_count, call.caller)
        else:
            raise InvalidInputError("pages to recalibrate with", "none", "pages of the source or a recording")
        for step in steps:
            if isinstance(step, Step):
                yield pb.RecalibrateReply(progress=pb.Progress(step=step.name, fraction=step.fraction))
            else:
                yield pb.RecalibrateReply(result=result_message(step))
