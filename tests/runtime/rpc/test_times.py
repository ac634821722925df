"""Where the time of calls goes: the stages of their pages are all of it; what is refused is counted by its cause."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from lightpage.errors import FrameError
from lightpage.recording.frame_pair import FramePair
from runtime.pb.lightpage.v1 import lightpage_pb2 as pb
from runtime.rpc.inference_calls import PREFIX
from runtime.service.caller import Caller
from runtime.service.limits import Limits
from runtime.service.stages import Stage
from tests.runtime import coded, toy
from tests.runtime.rpc.stage import Running, Start, a_page, parts
from tests.runtime.rpc.test_inference import infer, request_of
from tests.waiting import eventually

EXACT_S = 1e-6
"""Sums of doubles of some seconds, in whatever order."""


def seconds(service: Running, method: str, stage: Stage) -> float:
    return service.count("lightpage_stage_seconds_sum", method=method, stage=stage.value)


def all_seconds(service: Running, method: str) -> float:
    return sum(seconds(service, method, stage) for stage in Stage)


def ended(service: Running, method: str, calls: int) -> bool:
    return eventually(lambda: service.count("lightpage_call_seconds_count", method=method) == calls)


def test_the_stages_of_a_pages_calls_are_all_of_their_time(start: Start) -> None:
    service = start()
    pair = a_page()[1]
    for _ in range(2):
        service.client.decode(pair, 16)
    with pytest.raises(FrameError):
        service.client.decode(FramePair(pair.quadrature, pair.in_phase), 16)
    infer(service, request_of(pair))
    service.client.read_page()
    for _ in range(2):
        service.client.read_page(3, request_id="once")
    assert len(list(service.client.read_pages(count=3))) == 3
    other_protocol = f"{PREFIX}ModelInfer"
    for method, calls, pages in (
        ("DecodeFrames", 3, 3),
        (other_protocol, 1, 1),
        ("ReadPage", 3, 3),
        ("ReadPages", 1, 3),
    ):
        assert ended(service, method, calls)
        whole = service.count("lightpage_call_seconds_sum", method=method)
        given = [seconds(service, method, stage) for stage in (Stage.RECEIVE, Stage.INFERENCE)]
        assert min(given) > 0
        assert service.count("lightpage_stage_seconds_count", method=method, stage="queue") == pages
        if method == "ReadPages":  # the end of the stream belongs to no page
            assert 0 < all_seconds(service, method) <= whole + EXACT_S
        else:
            assert all_seconds(service, method) == pytest.approx(whole, abs=EXACT_S)
    assert service.count("lightpage_stage_seconds_count", method="DecodeFrames", stage="respond") == 2
    assert service.count("lightpage_rejects_total", reason="FRAMES_DISAGREE") == 1
    assert service.count("lightpage_calls_in_flight") == 0


def test_waiting_for_a_slot_is_told_apart_from_the_work(start: Start) -> None:
    service, size = start(limits=Limits(concurrent_decodes=1)), 2 * toy.SHAPE[0] * toy.SHAPE[1]
    with ThreadPoolExecutor(1) as pool:
        with service.plane.decodes.held(Caller()):
            assert (service.count("lightpage_decodes_busy"), service.count("lightpage_decodes_slots")) == (1, 1)
            calling = pool.submit(service.client.decode, a_page()[1], 16)
            eventually(lambda: service.count("lightpage_decodes_waiting") == 1)
            assert service.count("lightpage_receive_buffer_bytes") == size
            assert service.count("lightpage_received_bytes_total") == size
            assert service.count("lightpage_receive_buffer_limit_bytes") == service.plane.limits.receive_bytes
        calling.result(60)
    assert ended(service, "DecodeFrames", 1)
    assert seconds(service, "DecodeFrames", Stage.QUEUE) > 0
    assert service.count("lightpage_receive_buffer_bytes") == 0
    assert service.count("lightpage_received_bytes_total") == size


def test_pairs_of_one_call_are_timed_each_and_their_refusals_counted(start: Start) -> None:
    service, pair = start(), a_page()[1]

    def stream() -> Iterator[pb.DecodeFramesRequest]:
        yield from parts(pair)
        yield from parts(FramePair(pair.quadrature, pair.in_phase))
        yield from parts(pair, columns_px=toy.SHAPE[1] - 1)
        yield from parts(pair)

    replies = list(service.stub.DecodePages(stream(), timeout=20))
    assert [reply.WhichOneof("outcome") for reply in replies] == ["decoded", "refused", "refused", "decoded"]
    assert ended(service, "DecodePages", 1)
    for stage, count in (("receive", 4), ("queue", 4), ("inference", 3), ("post_processing", 2), ("respond", 4)):
        assert service.count("lightpage_stage_seconds_count", method="DecodePages", stage=stage) == count, stage
    assert service.count("lightpage_rejects_total", reason="FRAMES_DISAGREE") == 1
    assert service.count("lightpage_rejects_total", reason="FRAME_FORMAT") == 1


def test_user_bytes_have_a_stage_of_their_own(start: Start, tmp_path: Path) -> None:
    bundle = coded.bundle(tmp_path / "toy.zip")
    service = start(bundle, source=coded.ShownPages(coded.pages(bundle, tmp_path)))
    service.client.read_page(1, user_data=True)
    service.client.read_page(1)
    assert len(list(service.client.read_data(0, 3))) >= 3
    assert ended(service, "ReadPage", 2)
    assert ended(service, "ReadData", 1)
    assert service.count("lightpage_stage_seconds_count", method="ReadPage", stage="code") == 1
    assert service.count("lightpage_stage_seconds_count", method="ReadData", stage="code") == 3
    whole = service.count("lightpage_call_seconds_sum", method="ReadPage")
    assert all_seconds(service, "ReadPage") == pytest.approx(whole, abs=EXACT_S)
