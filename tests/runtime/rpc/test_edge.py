"""The service towards many callers, and bad ones: it stays right, polite and small."""

from __future__ import annotations

import asyncio
import gc
import queue
import threading
import time
import tracemalloc
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest
from google.protobuf import descriptor_pb2
from google.protobuf.message import Message
from google.rpc import error_details_pb2, status_pb2
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc

from lightpage.recording.frame_pair import FramePair
from runtime.bundle.bundle import Bundle
from runtime.decoding.decoder import Decoder
from runtime.decoding.tracking import NoTracker
from runtime.errors import OverloadedError, SlotsTakenError
from runtime.pb.lightpage.v1 import lightpage_pb2 as pb
from runtime.rpc.call import SERVICE, Call
from runtime.rpc.health_server import HealthServer
from runtime.rpc.inference_calls import INFERENCE
from runtime.rpc.server import LightpageServer
from runtime.service.caller import Caller
from runtime.service.dataplane import DataPlane
from runtime.service.limits import Limits
from runtime.service.recalibrator import Recalibrator
from runtime.service.registry import ModelRegistry
from runtime.service.slots import Slots
from runtime.wire.status import STATUS_KEY
from tests.runtime import toy
from tests.runtime.rpc.stage import Start, a_page, wait_until


def header(**changes: Any) -> pb.DecodeHeader:
    rows, columns = toy.PROFILE.frame_shape
    given = {"rows_px": rows, "columns_px": columns, "pixel_type": pb.PIXEL_TYPE_UINT8, "bit_depth": 8, **changes}
    return pb.DecodeHeader(**{"options": pb.DecodeOptions(levels=16), **given})


def parts(pair: FramePair, **changes: Any) -> Iterator[pb.DecodeFramesRequest]:
    yield pb.DecodeFramesRequest(header=header(**changes))
    for frame in (pair.in_phase, pair.quadrature):
        yield pb.DecodeFramesRequest(chunk=frame.tobytes())


def details(error: grpc.RpcError) -> dict[str, Any]:
    """google.rpc's details of an error, by name."""
    call: Any = error
    packed = next(value for key, value in call.trailing_metadata() if key == STATUS_KEY)
    status = status_pb2.Status.FromString(packed)
    assert status.code == call.code().value[0]
    found: dict[str, Any] = {}
    for each in status.details:
        for kind in (error_details_pb2.ErrorInfo, error_details_pb2.RetryInfo, error_details_pb2.BadRequest):
            message: Message = kind()
            if each.Unpack(message):
                found[kind.__name__] = message
    return found


def raw(channel: grpc.Channel, method: str, data: bytes, timeout: float = 10) -> bytes:
    answer: bytes = channel.unary_unary(f"/{SERVICE.full_name}/{method}")(data, timeout=timeout)
    return answer


def resident() -> int:
    """Bytes of this process in memory."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


def test_messages_that_cannot_be_parsed_are_the_callers_fault_and_leave_nothing(start: Start) -> None:
    service = start()
    with grpc.insecure_channel(service.server.target) as channel:
        for method in (m.name for m in SERVICE.methods if not m.client_streaming and not m.server_streaming):
            with pytest.raises(grpc.RpcError) as error:
                raw(channel, method, b"\xff\xff\xff")
            if error.value.code() is grpc.StatusCode.UNIMPLEMENTED:
                continue
            assert error.value.code() is grpc.StatusCode.INVALID_ARGUMENT
            assert details(error.value)["ErrorInfo"].reason == "MALFORMED"
        before = 0
        for turn in range(1500):
            with pytest.raises(grpc.RpcError):
                raw(channel, "ReadPage", b"\xff\xff\xff")
            if turn == 500:
                gc.collect()
                before = resident()
        gc.collect()
        assert (resident() - before) / 1000 < 5000  # 19 kB of each stayed where the library parsed them
    assert service.count("lightpage_calls_total", method="ReadPage", code="INVALID_ARGUMENT") == 1501


def test_a_message_of_a_stream_that_cannot_be_parsed_is_the_callers_fault(start: Start) -> None:
    service = start()
    with grpc.insecure_channel(service.server.target) as channel:
        for messages in ([b"\xff\xff"], [pb.DecodeFramesRequest(header=header()).SerializeToString(), b"\xff\xff"]):
            with pytest.raises(grpc.RpcError) as error:
                channel.stream_unary(f"/{SERVICE.full_name}/DecodeFrames")(iter(messages), timeout=10)
            assert error.value.code() is grpc.StatusCode.INVALID_ARGUMENT


class SlowTracker(NoTracker):
    """A decode takes as long as a test says."""

    seconds = 0.2

    def decode(self, *arguments: Any) -> Any:
        time.sleep(self.seconds)
        return super().decode(*arguments)


def test_under_overload_nothing_is_begun_that_cannot_be_finished(start: Start) -> None:
    """Ten callers for each slot whose deadline is six decodes away: every decode serves somebody, others are told when
    to come back, and health checks are answered meanwhile."""
    service = start(Limits(concurrent_decodes=1), tracker=SlowTracker)
    pair = a_page()[1]
    with grpc.insecure_channel(service.server.target) as channel:
        decode = service.stub(channel).DecodeFrames
        decode(parts(pair), timeout=20)
        done, refused, other, late_checks = 0, [], [], []
        stop = threading.Event()
        lock = threading.Lock()

        def call() -> None:
            nonlocal done
            with grpc.insecure_channel(service.server.target, options=[("grpc.use_local_subchannel_pool", 1)]) as mine:
                mine_decode = service.stub(mine).DecodeFrames
                while not stop.is_set():
                    try:
                        mine_decode(parts(pair), timeout=1.2)
                    except grpc.RpcError as error:
                        with lock:
                            (refused if error.code() is grpc.StatusCode.RESOURCE_EXHAUSTED else other).append(error)
                        time.sleep(0.05)
                    else:
                        with lock:
                            done += 1

        def check() -> None:
            stub = health_pb2_grpc.HealthStub(channel)
            while not stop.is_set():
                begun = time.monotonic()
                assert stub.Check(health_pb2.HealthCheckRequest(), timeout=5).status
                late_checks.append(time.monotonic() - begun)
                time.sleep(0.02)

        before = service.count("lightpage_pages_total", model_version="toy-1")
        begun = time.monotonic()
        threads = [threading.Thread(target=call) for _ in range(10)] + [threading.Thread(target=check)]
        for thread in threads:
            thread.start()
        time.sleep(4.0)
        stop.set()
        for thread in threads:
            thread.join(20)
        seconds = time.monotonic() - begun
    decodes = service.count("lightpage_pages_total", model_version="toy-1") - before
    assert not other
    assert decodes == done  # no decode in vain
    assert done >= 0.7 * seconds / SlowTracker.seconds
    assert refused
    reasons = {details(error)["ErrorInfo"].reason for error in refused}
    assert reasons == {"OVERLOADED"}
    assert all(details(error)["RetryInfo"].retry_delay.ToMilliseconds() > 0 for error in refused)
    assert service.count("lightpage_calls_total", method="DecodeFrames", code="RESOURCE_EXHAUSTED") == len(refused)
    assert len(late_checks) > 20


def test_a_deadline_shorter_than_a_decode_is_told_so(start: Start) -> None:
    service = start(tracker=SlowTracker)
    service.client.read_page()
    with grpc.insecure_channel(service.server.target) as channel, pytest.raises(grpc.RpcError) as error:
        service.stub(channel).ReadPage(pb.ReadPageRequest(), timeout=0.1)
    assert error.value.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
    found = details(error.value)
    assert found["ErrorInfo"].reason == "DEADLINE_TOO_SHORT"
    assert "RetryInfo" not in found
    assert service.client.read_page().page == 1  # no page was lost by it


def test_first_come_is_first_served() -> None:
    slots = Slots(1, "tests", 20.0)
    slots.take(Caller())
    served: queue.SimpleQueue[int] = queue.SimpleQueue()

    def wait(number: int) -> None:
        with slots.held(Caller()):
            served.put(number)

    with ThreadPoolExecutor(12) as pool:
        for number in range(12):
            pool.submit(wait, number)
            assert wait_until(lambda number=number: slots.queued == number + 1)  # type: ignore[misc]
        slots.give_back()
    assert [served.get() for _ in range(12)] == list(range(12))


def test_one_who_leaves_the_queue_is_gone_at_once() -> None:
    slots = Slots(1, "tests", 20.0)
    slots.take(Caller())
    caller, ended = Caller(), threading.Event()

    def wait() -> None:
        with pytest.raises(Exception, match=r"^$"):
            slots.take(caller)
        ended.set()

    thread = threading.Thread(target=wait)
    thread.start()
    assert wait_until(lambda: slots.queued == 1)
    caller.leave()
    assert ended.wait(1.0)
    thread.join(5)
    assert slots.queued == 0
    slots.give_back()
    assert slots.busy == 0


def test_who_would_wait_too_long_is_turned_away_before_anything_is_spent() -> None:
    slots = Slots(2, "decodes", 60.0)
    slots.took(1.0)
    slots.check(Caller(lambda: 1.2))
    with pytest.raises(OverloadedError, match=r"0\.50 s until the deadline") as alone:
        slots.check(Caller(lambda: 0.5))
    assert alone.value.retry_s is None  # no use to come back with that deadline
    slots.take(Caller())
    slots.take(Caller())
    with pytest.raises(OverloadedError, match="try again later") as queued:
        slots.check(Caller(lambda: 1.2))
    assert queued.value.retry_s is not None
    slots.check(Caller(lambda: 2.0))
    with pytest.raises(SlotsTakenError):
        slots.take(Caller(lambda: 0.05))


def test_slow_calls_are_forgotten() -> None:
    """Where all are refused, nothing else would show that calls are fast again."""
    now = [0.0]
    slots = Slots(1, "decodes", 60.0, clock=lambda: now[0])
    for _ in range(30):
        slots.took(5.0)
    with pytest.raises(OverloadedError):
        slots.check(Caller(lambda: 3.0))
    now[0] = 30.1
    slots.check(Caller(lambda: 3.0))
    with slots.held(Caller(lambda: 3.0)):
        pass
    slots.took(0.1)
    with pytest.raises(OverloadedError):
        slots.check(Caller(lambda: 0.1))


def test_a_few_slow_calls_turn_nobody_away() -> None:
    """A page in twenty that is searched for, say, does not shut out callers whose pages are not."""
    slots = Slots(1, "decodes", 60.0)
    for _ in range(19):
        slots.took(0.1)
    slots.took(5.0)
    slots.check(Caller(lambda: 0.12))
    slots.took(5.0)
    with pytest.raises(OverloadedError):
        slots.check(Caller(lambda: 0.12))


class Remembering(NoTracker):
    """Its answers depend on what it decoded before, as those of a tracker do that was led astray."""

    def __init__(self, decoder: Decoder) -> None:
        super().__init__(decoder)
        self._mine, self.pages = decoder, 0

    def decode(self, *arguments: Any) -> Any:
        page = super().decode(*arguments)
        self.pages += 1
        return type(page)(**{**vars(page), "piston_rad": float(self.pages)})

    def anew(self) -> Remembering:
        return Remembering(self._mine)


def test_answers_do_not_depend_on_what_others_sent(start: Start) -> None:
    service = start(tracker=Remembering)
    pair = a_page()[1]
    with grpc.insecure_channel(service.server.target) as channel:
        decode = service.stub(channel).DecodeFrames

        def pistons(count: int, **options: Any) -> list[float]:
            asked = pb.DecodeOptions(levels=16, **options)
            return [decode(parts(pair, options=asked), timeout=20).piston_rad for _ in range(count)]

        assert pistons(2, session="mine") == [1, 2]
        assert pistons(3, session="other") == [1, 2, 3]
        assert pistons(1, session="mine") == [3]
        assert pistons(3, tracking=pb.TRACKING_STATELESS) == [1, 1, 1]
        assert pistons(2) == [1, 2]  # the connection's own
        with grpc.insecure_channel(service.server.target, options=[("grpc.use_local_subchannel_pool", 1)]) as another:
            mine = service.stub(another).DecodeFrames
            assert mine(parts(pair), timeout=20).piston_rad == 1
        assert service.client.read_page().piston_rad == 1  # the device's own
        read = service.stub(channel).ReadPage
        assert read(pb.ReadPageRequest(options=pb.DecodeOptions(session="mine")), timeout=20).decoded.piston_rad == 4


def test_many_sessions_are_bounded(start: Start) -> None:
    from runtime.service.sessions import Sessions

    made = list[object]()
    sessions = Sessions(lambda: made.append(object()) or made[-1], most=3)  # type: ignore[arg-type,return-value,func-returns-value]
    first = sessions.tracker("0")
    for number in range(1, 3):
        sessions.tracker(str(number))
    assert sessions.tracker("0") is first
    sessions.tracker("3")
    assert sessions.tracker("0") is first
    sessions.tracker("1")
    assert len(made) == 5


def test_the_same_request_id_takes_one_shot(start: Start) -> None:
    service = start()
    with grpc.insecure_channel(service.server.target) as channel:
        read = service.stub(channel).ReadPage
        first = read(pb.ReadPageRequest(request_id="a", correlation_id="one"), timeout=20)
        again = read(pb.ReadPageRequest(request_id="a", correlation_id="two"), timeout=20)
        other = read(pb.ReadPageRequest(request_id="b"), timeout=20)
        assert (first.page, again.page, other.page) == (0, 0, 1)
        assert (first.replayed, again.replayed, other.replayed) == (False, True, False)
        assert again.decoded.symbols == first.decoded.symbols
        assert [answer.decoded.correlation_id for answer in (first, again)] == ["one", "two"]
        with pytest.raises(grpc.RpcError) as error:
            read(pb.ReadPageRequest(request_id="a", page=5), timeout=20)
        assert details(error.value)["ErrorInfo"].reason == "REQUEST_ID"


def test_a_page_whose_caller_gave_up_is_not_lost(start: Start) -> None:
    service = start(tracker=SlowTracker)
    with grpc.insecure_channel(service.server.target) as channel:
        read = service.stub(channel).ReadPage
        asked = pb.ReadPageRequest(request_id="once")
        with pytest.raises(grpc.RpcError) as error:
            read(asked, timeout=0.1)
        assert error.value.code() is grpc.StatusCode.DEADLINE_EXCEEDED
        answers = [read.future(asked, timeout=20) for _ in range(3)]  # the decode may still run
        assert [answer.result().page for answer in answers] == [0, 0, 0]
        assert all(answer.result().replayed for answer in answers)
    assert service.client.read_page().page == 1
    assert wait_until(lambda: service.count("lightpage_calls_total", method="ReadPage", code="DEADLINE_EXCEEDED") == 1)


def test_pairs_are_decoded_in_a_row_and_a_bad_one_ends_nothing(start: Start) -> None:
    service = start()
    symbols = [a_page(seed=seed)[0] for seed in range(4)]
    pairs = [a_page(seed=seed)[1] for seed in range(4)]
    black = FramePair(np.zeros_like(pairs[0].in_phase), np.zeros_like(pairs[0].quadrature))
    rows, columns = toy.PROFILE.frame_shape

    def stream() -> Iterator[pb.DecodeFramesRequest]:
        yield from parts(pairs[0], frame_id=7, captured_s=1.5, correlation_id="first")
        yield from parts(black, frame_id=8)
        yield from parts(pairs[1], bit_depth=12, frame_id=9)
        yield from parts(pairs[2], options=pb.DecodeOptions(levels=1), frame_id=10)
        yield from parts(pairs[3], frame_id=11)

    with grpc.insecure_channel(service.server.target) as channel:
        replies = list(service.stub(channel).DecodePages(stream(), timeout=20))
        kinds = [reply.WhichOneof("outcome") for reply in replies]
        assert kinds == ["decoded", "refused", "refused", "refused", "decoded"]
        first, last = replies[0].decoded, replies[-1].decoded
        assert (first.frame_id, first.captured_s, first.correlation_id) == (7, 1.5, "first")
        assert first.symbols == symbols[0].tobytes()
        assert last.symbols == symbols[3].tobytes()
        refused = [reply.refused for reply in replies[1:4]]
        assert [one.frame_id for one in refused] == [8, 9, 10]
        assert [one.reason for one in refused] == [
            pb.ERROR_REASON_FRAME_BLACK,
            pb.ERROR_REASON_FRAME_FORMAT,
            pb.ERROR_REASON_INVALID_VALUE,
        ]
        assert {one.code for one in refused} == {grpc.StatusCode.INVALID_ARGUMENT.value[0]}
        with pytest.raises(grpc.RpcError) as error:
            list(service.stub(channel).DecodePages(iter([pb.DecodeFramesRequest(chunk=b"1")]), timeout=20))
        assert details(error.value)["ErrorInfo"].reason == "MALFORMED"
        half = [next(parts(pairs[0])), pb.DecodeFramesRequest(chunk=bytes(rows * columns))]
        cut = list(service.stub(channel).DecodePages(iter(half), timeout=20))
        assert cut[0].refused.reason == pb.ERROR_REASON_FRAME_FORMAT
    assert service.plane.received.used == 0


class Naming(NoTracker):
    """Tells in its pages which session they were decoded in."""

    def __init__(self, decoder: Decoder, number: float = 0.0) -> None:
        super().__init__(decoder)
        self._mine, self._number, self._made = decoder, number, iter(range(1, 100))

    def decode(self, *arguments: Any) -> Any:
        page = super().decode(*arguments)
        return type(page)(**{**vars(page), "piston_rad": self._number})

    def anew(self) -> Naming:
        return Naming(self._mine, float(next(self._made)))


def test_pairs_of_one_call_stay_in_the_sessions_that_they_name(start: Start) -> None:
    service = start(Limits(concurrent_decodes=1), tracker=Naming)
    service.plane.decodes.take(Caller())
    pair = a_page()[1]

    def stream() -> Iterator[pb.DecodeFramesRequest]:
        for session in ("one", "two"):
            yield from parts(pair, options=pb.DecodeOptions(levels=16, session=session))

    with grpc.insecure_channel(service.server.target) as channel:
        replies = service.stub(channel).DecodePages(stream(), timeout=20)
        assert wait_until(lambda: service.plane.decodes.queued == 2)
        service.plane.decodes.give_back()
        assert sorted(reply.decoded.piston_rad for reply in replies) == [1, 2]


@pytest.mark.parametrize("method", ["DecodeFrames", "DecodePages"])
@pytest.mark.parametrize("rows", [0, 1])
def test_one_who_sends_next_to_nothing_for_ever_is_cut_off(start: Start, method: str, rows: int) -> None:
    """Behind a whole pair (DecodeFrames), behind a pair that is refused (one row more), and in the middle of one."""
    service = start(Limits(receive_s=0.5))
    over = threading.Event()

    def dripping() -> Iterator[pb.DecodeFramesRequest]:
        whole = method == "DecodeFrames" and not rows
        yield pb.DecodeFramesRequest(header=header(rows_px=toy.PROFILE.frame_shape[0] + rows))
        if whole:
            yield from list(parts(a_page()[1]))[1:]
        while not over.wait(0.05):
            yield pb.DecodeFramesRequest(chunk=b"")

    with grpc.insecure_channel(service.server.target) as channel:
        call = getattr(service.stub(channel), method)
        with pytest.raises(grpc.RpcError) as error:
            list(call(dripping(), timeout=10))
        over.set()
    refused_at_once = method == "DecodeFrames" and rows
    expected = grpc.StatusCode.INVALID_ARGUMENT if refused_at_once else grpc.StatusCode.CANCELLED
    assert error.value.code() is expected
    assert wait_until(lambda: service.plane.received.used == 0)


def test_pages_of_the_source_are_read_in_a_row(start: Start) -> None:
    service = start()
    with grpc.insecure_channel(service.server.target) as channel:
        read = service.stub(channel).ReadPages
        replies = list(read(pb.ReadPagesRequest(pages=[3, 1], correlation_id="mine"), timeout=20))
        assert [reply.read.page for reply in replies] == [3, 1]
        assert {reply.read.decoded.correlation_id for reply in replies} == {"mine"}
        assert [reply.read.page for reply in read(pb.ReadPagesRequest(count=2), timeout=20)] == [0, 1]
        with pytest.raises(grpc.RpcError) as error:
            list(read(pb.ReadPagesRequest(), timeout=20))
        assert details(error.value)["BadRequest"].field_violations[0].field == "count"


def test_the_black_level_is_taken_off(start: Start) -> None:
    service = start()
    symbols, pair = a_page()
    raised = FramePair(
        *(np.minimum(frame.astype(int) + 6, 255).astype(np.uint8) for frame in (pair.in_phase, pair.quadrature))
    )
    with grpc.insecure_channel(service.server.target) as channel:
        decode = service.stub(channel).DecodeFrames
        assert decode(parts(raised, black_level=6), timeout=20).symbols == symbols.tobytes()
        with pytest.raises(grpc.RpcError, match="black_level"):
            decode(parts(raised, black_level=256), timeout=20)


def test_a_bit_depth_is_checked_before_a_number_of_as_many_bits_is_made(start: Start) -> None:
    service = start()
    # The second one has no pixels, so that nothing of it is left to be read.
    headers = [header(bit_depth=bits, rows_px=rows, black_level=100) for bits, rows in ((4, 1), (2**32 - 1, 0), (0, 1))]
    with grpc.insecure_channel(service.server.target) as channel:
        stub = service.stub(channel)
        for each in headers:
            with pytest.raises(grpc.RpcError) as error:
                stub.DecodeFrames(iter([pb.DecodeFramesRequest(header=each)]), timeout=20)
            assert details(error.value)["ErrorInfo"].reason == "FRAME_FORMAT"
        many = [pb.DecodeFramesRequest(header=headers[1])] * 3
        tracemalloc.start()
        try:
            replies = list(stub.DecodePages(iter(many), timeout=20))
            assert tracemalloc.get_traced_memory()[1] < 64 << 20, "memory at most, beyond what there was before"
        finally:
            tracemalloc.stop()
    assert [reply.refused.reason for reply in replies] == [pb.ERROR_REASON_FRAME_FORMAT] * 3


def test_levels_0_mean_the_same_in_every_call(start: Start) -> None:
    service = start()
    with grpc.insecure_channel(service.server.target) as channel:
        stub = service.stub(channel)
        usual = stub.Describe(pb.DescribeRequest(), timeout=20).default_levels
        assert usual == 16  # the source's
        assert stub.DecodeFrames(parts(a_page()[1], options=pb.DecodeOptions()), timeout=20).levels == usual
        assert stub.ReadPage(pb.ReadPageRequest(), timeout=20).decoded.levels == usual


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda pair: FramePair(pair.in_phase * 0, pair.quadrature), "FRAME_BLACK"),
        (lambda pair: FramePair(pair.in_phase * 0 + 255, pair.quadrature), "FRAME_SATURATED"),
        (lambda pair: FramePair(pair.in_phase[:-1], pair.quadrature[:-1]), "FRAME_FORMAT"),
    ],
)
def test_what_is_wrong_with_frames_can_be_told_by_a_program(start: Start, make: Any, reason: str) -> None:
    service = start()
    with grpc.insecure_channel(service.server.target) as channel, pytest.raises(grpc.RpcError) as error:
        service.stub(channel).DecodeFrames(parts(make(a_page()[1])), timeout=20)
    found = details(error.value)
    assert found["ErrorInfo"].reason == reason
    assert found["ErrorInfo"].domain == "lightpage"
    assert found["BadRequest"].field_violations


def test_too_many_calls_at_once_are_refused_and_counted(start: Start) -> None:
    service = start(Limits(concurrent_calls=3, concurrent_decodes=1, deadline_s=5))
    service.plane.decodes.take(Caller())
    with grpc.insecure_channel(service.server.target) as channel:
        read = service.stub(channel).ReadPage
        waiting = [read.future(pb.ReadPageRequest(), timeout=20) for _ in range(3)]
        assert wait_until(lambda: service.count("lightpage_calls_in_flight") == 3)
        with pytest.raises(grpc.RpcError) as error:
            service.stub(channel).Describe(pb.DescribeRequest(), timeout=5)
        assert details(error.value)["ErrorInfo"].reason == "OVERLOADED"
        assert health_pb2_grpc.HealthStub(channel).Check(health_pb2.HealthCheckRequest(), timeout=5).status
        service.plane.decodes.give_back()
        assert {call.result().page for call in waiting} == {0, 1, 2}
    assert service.count("lightpage_calls_total", method="Describe", code="RESOURCE_EXHAUSTED") == 1


def test_watchers_do_not_hold_the_stop(start: Start) -> None:
    service = start()
    with grpc.insecure_channel(service.server.target) as channel:
        watch = health_pb2_grpc.HealthStub(channel).Watch(health_pb2.HealthCheckRequest(), timeout=30)
        assert next(watch).status == health_pb2.HealthCheckResponse.SERVING
        begun = time.monotonic()
        service.server.stop(20.0)
        assert time.monotonic() - begun < 5
        assert next(watch).status == health_pb2.HealthCheckResponse.NOT_SERVING
        with pytest.raises(grpc.RpcError):
            next(watch)


def test_what_a_stop_cuts_off_or_turns_away_hears_why(start: Start, caplog: pytest.LogCaptureFixture) -> None:
    service = start(Limits(concurrent_decodes=1))
    service.plane.decodes.take(Caller())
    stopped = threading.Thread(target=service.server.stop, args=(1.5,))
    with grpc.insecure_channel(service.server.target) as channel:
        stub = service.stub(channel)
        calls = [
            stub.ReadPage.future(pb.ReadPageRequest(), timeout=20),
            stub.DecodeFrames.future(parts(a_page()[1]), timeout=20),
        ]
        assert wait_until(lambda: service.count("lightpage_calls_in_flight") == 2)
        stopped.start()
        assert wait_until(lambda: not service.server.health()[""])
        with pytest.raises(grpc.RpcError) as turned_away:
            stub.Describe(pb.DescribeRequest(), timeout=5)
        for error in (turned_away.value, *(call.exception() for call in calls)):
            assert error.code() == grpc.StatusCode.UNAVAILABLE
            assert details(error)["ErrorInfo"].reason == "STOPPING"
    service.plane.decodes.give_back()
    stopped.join(10)
    assert not [record for record in caplog.records if record.exc_info]


def test_the_health_of_all_services_is_told_by_both_servers(start: Start) -> None:
    service = start()
    with HealthServer("127.0.0.1:0", service.server.health) as health:
        for target in (service.server.target, health.target):
            with grpc.insecure_channel(target) as channel:
                ask = health_pb2_grpc.HealthStub(channel)

                def states(ask: Any = ask) -> dict[str, int]:
                    answer = ask.List(health_pb2.HealthListRequest(), timeout=5)
                    return {name: one.status for name, one in answer.statuses.items()}

                names = ("", SERVICE.full_name, INFERENCE.full_name, "lightpage.store")
                wanted = dict.fromkeys(names, health_pb2.HealthCheckResponse.SERVING)
                assert wait_until(lambda states=states, wanted=wanted: states() == wanted)
                for name in names:
                    assert ask.Check(health_pb2.HealthCheckRequest(service=name), timeout=5).status == wanted[name]
        service.server.stop(0.5)
        assert not any(service.server.health().values())


def test_a_source_in_trouble_is_told_by_health_and_metrics_until_it_is_well(start: Start) -> None:
    service, trouble = start(), ["a beam may be blocked"]
    assert service.count("lightpage_source_ok") == 1
    service.source.trouble = lambda: "".join(trouble)  # type: ignore[method-assign]
    states = service.server.health()
    assert {name for name, serves in states.items() if not serves} == {*states} - {"lightpage.store"}
    assert service.count("lightpage_source_ok") == 0
    with grpc.insecure_channel(service.server.target) as channel:
        ask, request = health_pb2_grpc.HealthStub(channel), health_pb2.HealthCheckRequest()
        assert ask.Check(request, timeout=5).status == health_pb2.HealthCheckResponse.NOT_SERVING
        trouble.clear()
        assert all(service.server.health().values())
        assert ask.Check(request, timeout=5).status == health_pb2.HealthCheckResponse.SERVING
    assert service.count("lightpage_source_ok") == 1


def test_a_service_that_starts_with_its_source_in_trouble_does_not_say_that_it_serves(toy_zip: Path) -> None:
    source = toy.ToySource(toy.ToyDevice())
    source.trouble = lambda: "a beam may be blocked"  # type: ignore[method-assign]
    plane = DataPlane(ModelRegistry(Decoder(Bundle.open(toy_zip), threads=1)), source)
    server = LightpageServer(plane, Recalibrator(plane, toy.fit_references))
    with server, grpc.insecure_channel(server.target) as channel:
        status = health_pb2_grpc.HealthStub(channel).Check(health_pb2.HealthCheckRequest(), timeout=5).status
        assert status == health_pb2.HealthCheckResponse.NOT_SERVING


def test_the_service_describes_its_contract_to_strangers(start: Start) -> None:
    service = start()
    with grpc.insecure_channel(service.server.target) as channel:
        stub = reflection_pb2_grpc.ServerReflectionStub(channel)
        ask = [reflection_pb2.ServerReflectionRequest(list_services="")]
        (answer,) = stub.ServerReflectionInfo(iter(ask), timeout=10)
        names = {one.name for one in answer.list_services_response.service}
    assert {SERVICE.full_name, INFERENCE.full_name, "grpc.health.v1.Health"} <= names


def test_nothing_of_the_contract_of_0_1_was_renumbered_or_renamed() -> None:
    packed = (Path(__file__).parent / "lightpage-0.1.0.desc").read_bytes()
    (before,) = descriptor_pb2.FileDescriptorSet.FromString(packed).file
    now = descriptor_pb2.FileDescriptorProto()
    pb.DESCRIPTOR.CopyToProto(now)
    assert (before.package, before.syntax) == (now.package, now.syntax)
    messages = {one.name: one for one in now.message_type}
    for message in before.message_type:
        fields = {one.name: one for one in messages[message.name].field}
        for field in message.field:
            kept = fields[field.name]
            assert (kept.number, kept.type, kept.type_name, kept.label) == (
                field.number,
                field.type,
                field.type_name,
                field.label,
            ), f"{message.name}.{field.name}"
    enums = {one.name: {value.name: value.number for value in one.value} for one in now.enum_type}
    for enum in before.enum_type:
        assert {value.name: value.number for value in enum.value}.items() <= enums[enum.name].items()
    (service,), (served,) = before.service, now.service
    methods = {one.name: one for one in served.method}
    for method in service.method:
        assert methods[method.name] == method
    assert len(before.message_type) > 20


def test_work_that_never_begins_leaves_nothing_behind() -> None:
    closed = threading.Event()

    async def cut_off(pool: ThreadPoolExecutor) -> None:
        call = Call("DecodeFrames", Caller(), pool)
        waiting = asyncio.ensure_future(call.in_thread(lambda: None, closed.set))
        await asyncio.sleep(0.05)
        waiting.cancel()
        await asyncio.sleep(0.05)

    hold = threading.Event()
    with ThreadPoolExecutor(1) as pool:
        pool.submit(hold.wait, 20)
        asyncio.run(cut_off(pool))
        assert closed.is_set()
        hold.set()
