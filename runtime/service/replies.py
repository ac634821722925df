"""What the service answers, as messages."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lightpage.codec.page_bytes import PageBytes
from lightpage.recording.layout import FrameInfo
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.wire.messages import DATA_LOSSES, FLOAT
from lightpage.runtime.client.wire.requests import image_message
from lightpage.runtime.client.wire.status import detail_of
from lightpage.runtime.service.dataplane import Answer, ReadAnswer
from lightpage.runtime.service.display.display import Wanted
from lightpage.runtime.service.models.models import ModelEntry
from lightpage.runtime.service.models.store import Origin
from lightpage.runtime.service.monitoring.monitor import (
    AIR,
    CHANGED,
    MARGIN,
    PISTON_WALK,
    RESIDUAL,
    SHARE,
    SHIFT,
    TRUST,
    UNREAD,
)
from lightpage.runtime.service.pages.user_data import DataPage


def decode_reply(answer: Answer, options: pb.DecodeOptions) -> pb.DecodeReply:
    """An answer as its message, for `options` that have been checked."""
    page, found = answer.page, answer.user_data
    rows, columns = page.symbols.shape
    return pb.DecodeReply(
        rows=rows,
        columns=columns,
        levels=page.levels,
        symbols=page.symbols.tobytes(),
        confidence=_confidence_bytes(page.confidence, options.confidence_format),
        confidence_format=options.confidence_format or pb.CONFIDENCE_FORMAT_FLOAT32,
        concentration=page.concentration.astype(FLOAT).tobytes() if options.want_concentration else b"",
        phase=page.phase.astype(FLOAT).tobytes() if options.want_phase else b"",
        piston_rad=page.piston_rad,
        pilot_coherence=page.pilot_coherence,
        pilot_trust=page.pilot_trust,
        claimed_bits=page.check.claimed_bits,
        confirmed_bits=page.check.confirmed_bits,
        recalibration_due=answer.recalibration_due,
        recalibration_reasons=_recalibration_reasons(answer),
        image=None if page.image is None else image_message(page.image),
        user_data=None if found is None else user_data_message(found),
        model_version=answer.model_version,
        timings=pb.Timings(
            receive_s=answer.receive_s,
            decode_s=page.timings.total_s,
            inference_s=page.timings.inference_s,
            total_s=answer.total_s,
        ),
    )


_SIGNS = {
    MARGIN.name: pb.RECALIBRATION_REASON_MARGIN,
    AIR.name: pb.RECALIBRATION_REASON_INFORMATION,
    TRUST.name: pb.RECALIBRATION_REASON_TRUST,
    SHARE.name: pb.RECALIBRATION_REASON_PILOT_SHARE,
    CHANGED.name: pb.RECALIBRATION_REASON_PAGES,
    UNREAD.name: pb.RECALIBRATION_REASON_UNREAD,
    RESIDUAL.name: pb.RECALIBRATION_REASON_RESIDUAL,
    SHIFT.name: pb.RECALIBRATION_REASON_SHIFT,
    PISTON_WALK.name: pb.RECALIBRATION_REASON_PISTON,
}


def _recalibration_reasons(answer: Answer) -> list[pb.RecalibrationReason]:
    own = [pb.RECALIBRATION_REASON_PAGE] if answer.page.check.recalibration_due else []
    return own + [_SIGNS.get(name, pb.RECALIBRATION_REASON_OTHER) for name in answer.monitor_signs]


def _confidence_bytes(confidence: NDArray[np.float32], code: int) -> bytes:
    if code == pb.CONFIDENCE_FORMAT_UINT8:
        return np.floor(confidence * 255).astype(np.uint8).tobytes()
    return confidence.astype(FLOAT).tobytes()


def user_data_message(found: PageBytes) -> pb.UserData:
    """What a page gave as its message."""
    header = found.header
    return pb.UserData(
        data=found.data or b"",
        loss=DATA_LOSSES[found.loss],
        header=None
        if header is None
        else pb.PageHeader(
            volume=header.volume, page=header.page, volume_bytes=header.volume_bytes, code_id=header.code_id
        ),
        data_pages=0 if found.file is None else found.file.data_pages,
        parity_pages=0 if found.file is None else found.file.parity_pages,
        file_checksum=0 if found.file is None else found.file.checksum,
        margin_bits=found.margin_bits,
        corrected=found.corrected,
        blocks=found.blocks,
        failed_blocks=found.failed_blocks,
        iterations=found.iterations,
    )


def data_reply(page: DataPage) -> pb.ReadDataReply:
    """A page of a range as its message."""
    found = pb.UserData(loss=pb.DATA_LOSS_OPTICS) if page.found is None else user_data_message(page.found)
    return pb.ReadDataReply(
        page=page.source_page or 0,
        user_data=found,
        restored=page.source_page is None,
        error=None if page.error is None else detail_of(page.error),
        model_version=page.model_version,
    )


def read_reply(read: ReadAnswer, request: pb.ReadPageRequest) -> pb.ReadPageReply:
    """A page read from the source as its message."""
    written = read.shot.symbols if request.want_written else None
    decoded = decode_reply(read.answer, request.options)
    decoded.correlation_id = request.correlation_id
    return pb.ReadPageReply(
        decoded=decoded,
        page=read.shot.page_index,
        written=b"" if written is None else written.tobytes(),
        pilot_mask=b"" if written is None else read.pilot_mask.astype(np.uint8).tobytes(),
        frames=[_camera_frame(info) for info in read.shot.infos or ()],
    )


def _camera_frame(info: FrameInfo) -> pb.CameraFrame:
    return pb.CameraFrame(
        serial=info.serial,
        frame_id=info.frame_id,
        device_time_s=info.device_time_s,
        host_time_s=info.host_time_s,
    )


def wanted_message(wanted: Wanted) -> pb.WatchDisplayReply:
    """What a controller is to show as its message."""
    beams = wanted.beams
    return pb.WatchDisplayReply(
        page=wanted.page,
        beams=None if beams is None else pb.Beams(signal=beams.signal, reference=beams.reference),
    )


_ORIGINS = {
    Origin.GIVEN: pb.MODEL_ORIGIN_GIVEN,
    Origin.RECALIBRATED: pb.MODEL_ORIGIN_RECALIBRATED,
    Origin.UPLOADED: pb.MODEL_ORIGIN_UPLOADED,
}


def model_message(entry: ModelEntry) -> pb.Model:
    """A model as its message; metrics that are no numbers stay behind."""
    manifest = entry.manifest
    return pb.Model(
        name=manifest.name,
        version=manifest.version,
        created=manifest.created,
        current=entry.current,
        metrics={k: float(v) for k, v in manifest.metrics.items() if isinstance(v, int | float)},
        pinned=entry.pinned,
        loaded=entry.loaded,
        origin=pb.MODEL_ORIGIN_UNSPECIFIED if entry.origin is None else _ORIGINS[entry.origin],
    )
