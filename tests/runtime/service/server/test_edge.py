"""The service towards many callers, and bad ones: it stays right, polite and small."""

import asyncio
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc

from lightpage.errors import CallerLeft, FrameError, LightpageError, StalledError
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.client.client import LightpageClient
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2_grpc as pb_grpc
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.service.caller import Call, Caller
from lightpage.runtime.service.frames.inference_calls import INFERENCE
from lightpage.runtime.service.limits import Limits
from lightpage.runtime.service.pages import page_calls
from lightpage.runtime.service.pages.page_calls import PageCalls
from lightpage.runtime.service.server.dispatcher import SERVICE
from tests.clock import HandClock
from tests.runtime import toy
from tests.runtime.conftest import begun
from tests.runtime.service.stage import Remembering, Running, Start, a_page, header, parts, refused, refused_as
from tests.waiting import eventually

SERVING, NOT_SERVING = health_pb2.HealthCheckResponse.SERVING, health_pb2.HealthCheckResponse.NOT_SERVING
INVALID, EXHAUSTED = grpc.StatusCode.INVALID_ARGUMENT, grpc.StatusCode.RESOURCE_EXHAUSTED


def health_of(service: Running) -> Any:
    return health_pb2_grpc.HealthStub(service.channel())


def test_a_deadline_that_is_too_short_is_told_so(start: Start) -> None:
    service = start(limits=Limits(concurrent_decodes=1))
    service.plane.decodes.took(15.0)
    with service.plane.decodes.held(Caller()):
        answer = refused(lambda: service.stub.DecodeFrames(parts(a_page()[1]), timeout=20))
        assert (answer.code, answer.reason) == (EXHAUSTED, "OVERLOADED")
        assert answer.told["RetryInfo"].retry_delay.ToMilliseconds() > 0
    assert service.count("lightpage_rejects_total", reason="OVERLOADED") == 1
    service.plane.decodes.took(60.0)
    answer = refused(lambda: service.stub.ReadPage(pb.ReadPageRequest(), timeout=20))
    assert (answer.code, answer.reason) == (EXHAUSTED, "DEADLINE_TOO_SHORT")
    assert "RetryInfo" not in answer.told
    assert service.stub.ReadPage(pb.ReadPageRequest()).page == 0  # no page was lost by it


def test_too_many_calls_at_once_are_refused_and_counted(start: Start) -> None:
    service = start(limits=Limits(concurrent_calls=3, concurrent_decodes=1))
    with service.plane.decodes.held(Caller()):
        waiting = [service.stub.ReadPage.future(pb.ReadPageRequest(), timeout=60) for _ in range(3)]
        eventually(lambda: service.count("lightpage_calls_in_flight") == 3)
        answer = refused(lambda: service.stub.Describe(pb.DescribeRequest(), timeout=20))
        assert (answer.code, answer.reason) == (EXHAUSTED, "OVERLOADED")
        assert health_of(service).Check(health_pb2.HealthCheckRequest(), timeout=20).status == SERVING
    assert {call.result().page for call in waiting} == {0, 1, 2}
    assert service.count("lightpage_calls_total", method="Describe", code="RESOURCE_EXHAUSTED") == 1


@pytest.mark.parametrize(("method", "rows"), [("DecodeFrames", 0), ("DecodePages", 0), ("DecodePages", 1)])
def test_one_who_sends_next_to_nothing_for_ever_is_cut_off(start: Start, method: str, rows: int) -> None:
    """Behind a whole pair (DecodeFrames), in the middle of one, and in one that is refused (one row more)."""
    service, over = start(limits=Limits.model_construct(receive_s=0.2)), threading.Event()  # no stall

    def dripping() -> Iterator[pb.DecodeFramesRequest]:
        yield pb.DecodeFramesRequest(header=header(rows_px=toy.PROFILE.frame_shape[0] + rows))
        if method == "DecodeFrames":
            yield from list(parts(a_page()[1]))[1:]
        while not over.wait(0.05):
            yield pb.DecodeFramesRequest(chunk=b"")

    answer = refused(lambda: getattr(service.stub, method)(dripping(), timeout=60))
    over.set()
    assert (answer.code, answer.reason) == (grpc.StatusCode.CANCELLED, "STALLED")
    eventually(lambda: service.plane.received.used == 0)


def test_work_that_never_begins_leaves_nothing_behind() -> None:
    closed, hold = threading.Event(), threading.Event()

    async def cut_off(pool: ThreadPoolExecutor) -> None:
        call = Call("DecodeFrames", Caller(), pool)
        waiting = asyncio.ensure_future(call.in_thread(lambda: None, closed.set))
        await asyncio.sleep(0)
        waiting.cancel()
        with pytest.raises(asyncio.CancelledError):
            await waiting

    with ThreadPoolExecutor(1) as pool:
        pool.submit(hold.wait, 60)
        asyncio.run(cut_off(pool))
        eventually(closed.is_set)
        hold.set()


def test_answers_do_not_depend_on_what_others_sent(start: Start) -> None:
    service, pair = start(tracker=Remembering), a_page()[1]

    def pistons(count: int, stub: Any = service.stub, **options: Any) -> list[float]:
        asked = pb.DecodeOptions(levels=16, **options)
        return [stub.DecodeFrames(parts(pair, options=asked), timeout=20).piston_rad for _ in range(count)]

    assert pistons(2, session="mine") == pistons(2, session="other") == [1, 2]
    assert pistons(1, session="mine") == [3]
    assert pistons(2, tracking=pb.TRACKING_STATELESS) == [1, 1]
    assert pistons(2) == [1, 2]  # the connection's own
    assert pistons(1, pb_grpc.LightpageStub(service.channel())) == [1]
    assert service.client.pages.read().piston_rad == 1  # the device's own
    assert [service.client.pages.read(session="mine").piston_rad, service.client.pages.read().piston_rad] == [4, 2]


def test_the_same_request_id_takes_one_shot(start: Start) -> None:
    read = start().stub.ReadPage
    first = read(pb.ReadPageRequest(request_id="a", correlation_id="one"), timeout=20)
    again = read(pb.ReadPageRequest(request_id="a", correlation_id="two"), timeout=20)
    other = read(pb.ReadPageRequest(request_id="b"), timeout=20)
    assert (first.page, again.page, other.page) == (0, 0, 1)
    assert (first.replayed, again.replayed, other.replayed) == (False, True, False)
    assert again.decoded.symbols == first.decoded.symbols
    assert [answer.decoded.correlation_id for answer in (first, again)] == ["one", "two"]
    answer = refused(lambda: read(pb.ReadPageRequest(request_id="a", page=5), timeout=20))
    assert (answer.code, answer.reason) == (INVALID, "REQUEST_ID")


def test_a_page_whose_caller_gave_up_is_not_lost(start: Start) -> None:
    service, go = start(), threading.Event()
    service.reading(lambda shot: shot if go.wait(60) else pytest.fail("nobody let it go on"))
    asked = pb.ReadPageRequest(request_id="once")
    with pytest.raises(grpc.RpcError) as error:
        service.stub.ReadPage(asked, timeout=0.2)
    assert error.value.code() is grpc.StatusCode.DEADLINE_EXCEEDED
    answers = [service.stub.ReadPage.future(asked, timeout=60) for _ in range(3)]  # the decode still runs
    go.set()
    assert [(answer.result().page, answer.result().replayed) for answer in answers] == [(0, True)] * 3
    assert service.client.pages.read().page == 1
    by_whose_clock = ("DEADLINE_EXCEEDED", "CANCELLED")  # a call that came late has time left when its caller gives up

    def ended() -> float:
        return sum(service.count("lightpage_calls_total", method="ReadPage", code=code) for code in by_whose_clock)

    eventually(lambda: ended() == 1)


def test_a_page_that_is_read_on_though_its_caller_left_has_the_services_own_deadline(
    decoder: Decoder, monkeypatch: pytest.MonkeyPatch
) -> None:
    running, clock, left = begun(decoder, limits=Limits(deadline_s=7.0)), HandClock(), list[float]()

    def read_page(plane: object, page: object, levels: object, caller: Caller, **_: object) -> None:
        for _ in range(2):
            left.append(caller.seconds_left())
            clock.advance(2.0)
        raise CallerLeft

    monkeypatch.setattr(page_calls, "read_page", read_page)
    call = Call("ReadPage", Caller(lambda: 1.0), ThreadPoolExecutor(1))
    with pytest.raises(CallerLeft):
        PageCalls(running.plane, clock).ReadPage(pb.ReadPageRequest(request_id="a"), call)
    running.end()
    assert left == [7.0, 5.0]


def test_pairs_are_decoded_in_a_row_and_a_bad_one_ends_nothing(service: Running) -> None:
    symbols, pairs = zip(*(a_page(seed=seed) for seed in range(2)), strict=True)
    black = FramePair(np.zeros_like(pairs[0].in_phase), np.zeros_like(pairs[0].quadrature))

    def stream() -> Iterator[pb.DecodeFramesRequest]:
        yield from parts(pairs[0], frame_id=7, captured_s=1.5, correlation_id="first")
        yield from parts(black, frame_id=8)
        yield from parts(pairs[1], bit_depth=12, frame_id=9)
        yield from parts(pairs[1], frame_id=10)

    replies = list(service.stub.DecodePages(stream(), timeout=20))
    assert [reply.WhichOneof("outcome") for reply in replies] == ["decoded", "refused", "refused", "decoded"]
    first, last = replies[0].decoded, replies[-1].decoded
    assert (first.frame_id, first.captured_s, first.correlation_id) == (7, 1.5, "first")
    assert (first.symbols, last.symbols) == (symbols[0].tobytes(), symbols[1].tobytes())
    refusals = [(reply.refused.frame_id, reply.refused.reason) for reply in replies[1:3]]
    assert refusals == [(8, pb.ERROR_REASON_FRAME_BLACK), (9, pb.ERROR_REASON_FRAME_FORMAT)]
    found = list(service.client.frames.decode_many([pairs[0], black, pairs[1]], correlation_id="mine"))
    assert isinstance(found[1], FrameError)
    assert [(page.frame_id, page.correlation_id) for page in found[::2]] == [(0, "mine"), (2, "mine")]  # type: ignore[union-attr]
    stray = iter([pb.DecodeFramesRequest(chunk=b"1")])
    assert refused(lambda: service.stub.DecodePages(stray, timeout=20)).reason == "MALFORMED"
    assert service.plane.received.used == 0


def test_pairs_of_one_call_stay_in_the_sessions_that_they_name(start: Start) -> None:
    service, pair = start(limits=Limits(concurrent_decodes=1), tracker=Remembering), a_page()[1]

    def stream() -> Iterator[pb.DecodeFramesRequest]:
        for session in ("one", "two", "one"):
            yield from parts(pair, options=pb.DecodeOptions(levels=16, session=session))

    with service.plane.decodes.held(Caller()):
        replies = service.stub.DecodePages(stream(), timeout=60)
        eventually(lambda: service.plane.decodes.queued == 2)  # while one is decoded the next one comes, and no third
    assert [reply.decoded.piston_rad for reply in replies] == [1, 1, 2]


def test_pages_of_the_source_are_read_in_a_row(start: Start) -> None:
    read = start(limits=Limits(range_pages=9)).stub.ReadPages
    assert [reply.read.page for reply in read(pb.ReadPagesRequest(count=9), timeout=20)] == list(range(9))
    assert refused(lambda: read(pb.ReadPagesRequest(), timeout=20)).subject == "count"
    for request, subject in ((pb.ReadPagesRequest(count=10), "count"), (pb.ReadPagesRequest(pages=range(10)), "pages")):
        answer = refused(lambda request=request: read(request, timeout=20))  # type: ignore[misc]
        assert (answer.code, answer.subject, answer.error.got) == (EXHAUSTED, subject, "10")


def test_a_source_in_trouble_is_told_by_health_and_metrics_until_it_is_well(start: Start) -> None:
    service, trouble = start(), ["a beam may be blocked"]
    ask, names = health_of(service), ("", SERVICE.full_name, INFERENCE.full_name, "lightpage.store")
    states = {one: state.status for one, state in ask.List(health_pb2.HealthListRequest(), timeout=20).statuses.items()}
    assert states == dict.fromkeys(names, SERVING)
    assert service.server.health() == dict.fromkeys(names, True)
    assert service.count("lightpage_source_ok") == 1
    service.source.trouble = lambda: "".join(trouble)
    assert {name for name, serves in service.server.health().items() if not serves} == {*names} - {"lightpage.store"}
    assert service.count("lightpage_source_ok") == 0
    assert ask.Check(health_pb2.HealthCheckRequest(), timeout=20).status == NOT_SERVING
    trouble.clear()
    assert all(service.server.health().values())
    assert ask.Check(health_pb2.HealthCheckRequest(), timeout=20).status == SERVING
    trouble.append("again")
    begun_so = start(source=service.source)  # does not say that it serves
    assert health_of(begun_so).Check(health_pb2.HealthCheckRequest(), timeout=20).status == NOT_SERVING


def test_watchers_hear_of_the_end_and_do_not_hold_it(start: Start) -> None:
    service = start()
    watch = health_of(service).Watch(health_pb2.HealthCheckRequest(service=SERVICE.full_name), timeout=60)
    assert next(watch).status == SERVING
    service.server.stop(600.0)
    assert next(watch).status == NOT_SERVING
    with pytest.raises(grpc.RpcError):
        next(watch)


def test_an_answer_in_flight_survives_the_stop(start: Start) -> None:
    service = start(limits=Limits(concurrent_decodes=1))
    with ThreadPoolExecutor(2) as pool:
        with service.plane.decodes.held(Caller()):
            page = pool.submit(service.client.frames.decode, a_page()[1], 16)
            eventually(lambda: service.plane.decodes.queued == 1)
            ending = pool.submit(service.server.stop, 600.0)
            eventually(lambda: not service.server.health()[""])
            assert not ending.done()  # it waits for the answer
        assert page.result(60).levels == 16
        ending.result(60)
    with pytest.raises(LightpageError):
        service.client.describe()


def test_what_a_stop_cuts_off_or_turns_away_hears_why(start: Start, caplog: pytest.LogCaptureFixture) -> None:
    service = start(limits=Limits(concurrent_decodes=1))
    with service.plane.decodes.held(Caller()), ThreadPoolExecutor(1) as pool:
        call = service.stub.ReadPage.future(pb.ReadPageRequest(), timeout=60)
        eventually(lambda: service.count("lightpage_calls_in_flight") == 1)
        ending = pool.submit(service.server.stop, 1.0)
        eventually(lambda: not service.server.health()[""])
        turned_away = refused(lambda: service.stub.Describe(pb.DescribeRequest(), timeout=20))
        told = [turned_away, refused_as(call.exception())]
        ending.result(60)
    assert {(one.code, one.reason) for one in told} == {(grpc.StatusCode.UNAVAILABLE, "STOPPING")}
    assert not [record for record in caplog.records if record.exc_info]


def test_clients_at_one_unix_socket_are_followed_apart(start: Start, tmp_path: Path) -> None:
    service, pair = start(tracker=Remembering, address=f"unix:{tmp_path}/s"), a_page()[1]
    one = service.client
    with LightpageClient(service.server.target, timeout_s=20) as two:
        assert [client.frames.decode(pair).piston_rad for client in (one, one, two)] == [1, 2, 1]
        assert [one.frames.decode(pair, stateless=True).piston_rad, one.frames.decode(pair).piston_rad] == [1, 3]
        assert [client.frames.decode(pair, session="both").piston_rad for client in (one, two)] == [1, 2]
        (page,) = two.frames.decode_many([pair])
        assert page.piston_rad == 2  # type: ignore[union-attr]
        assert one.pages.read().piston_rad == 1  # the device's own
    decode = service.stub.DecodeFrames  # names no session
    assert [decode(parts(pair), timeout=20).piston_rad for _ in range(2)] == [1, 1]


def test_calls_that_outlive_the_grace_are_ended(start: Start) -> None:
    service = start(limits=Limits(concurrent_decodes=1, connection_age_s=0.2, connection_grace_s=0.2))
    with service.plane.decodes.held(Caller()):
        answer = refused(lambda: service.stub.ReadPage(pb.ReadPageRequest(), timeout=60))
    assert answer.code is grpc.StatusCode.UNAVAILABLE


SMALL_WINDOW = (("grpc.http2.bdp_probe", 0), ("grpc.http2.lookahead_bytes", 1024))
"""So that few replies fill what the network holds."""
UNREAD = pb.ReadPagesRequest(count=4096, options=pb.DecodeOptions(want_phase=True, want_concentration=True))


def unread(service: Running, count: int) -> list[grpc.Call]:
    """Streams of replies that nobody takes."""
    service.channels.append(grpc.insecure_channel(service.server.target, SMALL_WINDOW))
    read = service.channels[-1].unary_stream("/lightpage.v1.Lightpage/ReadPages", pb.ReadPagesRequest.SerializeToString)
    return [read(UNREAD, timeout=600) for _ in range(count)]


def test_ranges_that_nobody_reads_keep_no_place(start: Start) -> None:
    service = start(limits=Limits(concurrent_ranges=2))
    calls = unread(service, 3)
    eventually(lambda: service.count("lightpage_calls_in_flight") == 3)
    eventually(lambda: service.plane.ranges.busy == 0)
    assert len(list(service.client.pages.read_many([1, 2, 3]))) == 3
    for call in calls:
        call.cancel()


def test_a_range_that_is_not_read_is_ended(start: Start, caplog: pytest.LogCaptureFixture) -> None:
    service = start(limits=Limits(reader_s=0.2, concurrent_calls=1))
    (call,) = unread(service, 1)
    eventually(lambda: service.count("lightpage_calls_in_flight") == 1)
    describe = service.stub.Describe.future
    eventually(lambda: describe(pb.DescribeRequest(), timeout=20).exception() is None)  # it counts as no load any more
    with pytest.raises(grpc.RpcError) as caught:
        list(call)  # type: ignore[call-overload]
    told = refused_as(caught.value)
    assert (told.code, type(told.error)) == (grpc.StatusCode.CANCELLED, StalledError)
    assert not [record for record in caplog.records if record.levelname == "ERROR"]


# A client of this library sends no two pings within 10 s, and the server forgives two: nothing shorter shows it.
@pytest.mark.long
def test_a_client_that_asks_for_a_sign_of_life_every_ten_seconds_is_not_hung_up_on(service: Running) -> None:
    options = (
        ("grpc.keepalive_time_ms", 10_000),
        ("grpc.keepalive_permit_without_calls", 1),
        ("grpc.http2.max_pings_without_data", 0),
    )
    lost, states = threading.Event(), list[grpc.ChannelConnectivity]()

    def changed(state: grpc.ChannelConnectivity) -> None:
        if grpc.ChannelConnectivity.READY in states:
            lost.set()
        states.append(state)

    with grpc.insecure_channel(service.server.target, options) as channel:
        channel.subscribe(changed, try_to_connect=True)
        grpc.channel_ready_future(channel).result(30)
        assert not lost.wait(55)
