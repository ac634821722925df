"""Messages and dataclasses made of each other by the names of their fields."""

from dataclasses import fields, replace

import numpy as np
import pytest

from lightpage.codec.page_bytes import FileFacts, Header, Loss, PageBytes
from lightpage.errors import InvalidInputError, LightpageError
from lightpage.runtime.client import answers
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.wire.messages import answer_of, message_of
from lightpage.runtime.model.decoding.image_position import ImagePosition
from lightpage.runtime.service.frames.frames import user_data_message


def test_a_page_goes_there_and_back_by_the_names_of_its_fields() -> None:
    named = {*pb.DecodeReply.DESCRIPTOR.fields_by_name, *pb.ReadPageReply.DESCRIPTOR.fields_by_name}
    assert {field.name for field in fields(answers.RemotePage)} <= named  # else one keeps its default for ever
    symbols, mask = np.arange(6, dtype=np.uint8).reshape(2, 3), np.eye(2, 3, dtype=bool)
    timings, image = answers.RemoteTimings(1, 2, 3, 4, 5), ImagePosition(0.5, -1.0, found=True)
    page = answers.RemotePage(
        symbols, np.float32(symbols / 8), None, np.float32(-symbols), 16, 0.5, 0.25, "toy-1", timings, image=image
    )
    reply = message_of(pb.DecodeReply, page, rows=2, columns=3, confidence_format="FLOAT32")
    reply.recalibration_reasons.extend([pb.RECALIBRATION_REASON_PAGE, 99])
    frames = [answers.RemoteFrame(serial, 7, 0.5, 1.5) for serial in "ab"]
    read = message_of(pb.ReadPageReply, page=0, written=symbols, pilot_mask=mask, frames=frames)
    back = answers.remote_page(reply, read)
    for name in ("symbols", "confidence", "phase", "written", "pilot_mask"):
        expected = {"written": symbols, "pilot_mask": mask}.get(name, getattr(page, name))
        assert getattr(back, name).dtype == expected.dtype, name
        assert (getattr(back, name) == expected).all(), name
    assert (back.page, back.frames, back.timings, back.image) == (0, tuple(frames), timings, image)
    assert (back.concentration, back.user_data, back.recalibration_reasons) == (None, None, ("PAGE", "OTHER"))
    assert answers.remote_page(reply).page is back.level_phases is None
    told = message_of(
        pb.DecodeReply, replace(page, level_phases=(0.0, 0.5)), rows=2, columns=3, confidence_format="FLOAT32"
    )
    assert answers.remote_page(told).level_phases == (0.0, 0.5)
    reply.symbols += b"0"
    with pytest.raises(LightpageError) as error:
        answers.remote_page(reply)
    assert error.value.subject == "reply: symbols"


@pytest.mark.parametrize("loss", [None, *(loss for loss in Loss if loss is not Loss.STORAGE)])
def test_bytes_of_a_page_come_back_as_they_were_and_an_unknown_loss_is_none_of_data(loss: Loss | None) -> None:
    whole = loss is None
    found = PageBytes(
        Header(1, 2, 3, 4), b"x" if whole else None, FileFacts(5, 6, 7) if whole else None, loss, 1.5, *[2] * 4
    )
    told = user_data_message(found)
    assert answers.page_bytes(told) == found
    told.loss = 99  # type: ignore[assignment]  # of a later version
    assert answers.page_bytes(told).loss is Loss.BODY


def test_what_a_later_version_says_is_unknown() -> None:
    assert answers.job_info(pb.Job(id="a", state=99)).state is answers.JobState.UNKNOWN  # type: ignore[arg-type]
    assert answer_of(answers.ModelInfo, pb.Model(origin=99)).origin == ""  # type: ignore[arg-type]


def test_a_field_that_no_source_has_and_one_that_there_is_not_are_refused() -> None:
    with pytest.raises(TypeError):
        message_of(pb.ImagePosition, object(), shift_x_px=1.0)
    with pytest.raises(InvalidInputError) as error:
        message_of(pb.ImagePosition, no_such_field=1.0)
    assert error.value.subject == "no_such_field"
