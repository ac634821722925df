"""A controller uploads pages, shows them when they are wanted, and says so."""

import asyncio
import threading
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from lightpage.errors import LimitError, NoSourceError, PageError
from lightpage.runtime.client.client import LightpageClient
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.device.acquisition.camera_source import CameraSource, Exposures
from lightpage.runtime.device.acquisition.page_store import PageStore
from lightpage.runtime.device.modulator.external import ExternalBeams, ExternalModulator
from lightpage.runtime.service.display.display_calls import uploaded_pages
from tests.runtime import toy
from tests.runtime.device.acquisition.lab import PAIRING, Lab, LabModulator
from tests.runtime.service.stage import Running, Start, refused, until_told
from tests.waiting import eventually

PAGES = np.stack([toy.symbols_of(16, number)[0] for number in (4, 9)])


def external(lab: Lab) -> tuple[CameraSource, LabModulator]:
    stage = LabModulator(lab, toy.ToyDevice())
    source = CameraSource(
        toy.PROFILE,
        (lab.cameras[0], lab.cameras[1]),
        lab,
        ExternalModulator(),
        ExternalBeams(5.0),
        PageStore(toy.PROFILE),
        PAIRING,
        Exposures(reference_frames=1),
        name="camera:lab",
        clock=lab.clock,
    )
    source.arm()
    return source, stage


def test_a_controller_shows_what_it_has_uploaded_and_moves_beams(start: Start) -> None:
    source, stage = external(Lab())
    client = start(source=source).client
    assert client.display.upload_pages(PAGES[:1], 16) == 0
    assert client.display.upload_pages(PAGES[1], 16) == 1

    def control() -> list[int]:
        seen = []
        with LightpageClient(client.target, timeout_s=20) as mine:
            for order in mine.display.watch(120.0):
                if order.beams is not None:
                    stage.let_through(signal=order.beams[0], reference=order.beams[1])
                    mine.display.report_beams(signal=order.beams[0], reference=order.beams[1])
                if order.page is not None:
                    seen.append(order.page)
                    stage.show(PAGES[order.page], 16, order.page, 1.0)
                    mine.display.report_page(order.page)
                if len(seen) == 2:
                    break
        return seen

    with ThreadPoolExecutor(1) as pool:
        controlling = pool.submit(control)
        assert (source.references().in_phase == toy.ToyDevice().references().in_phase).all()
        for page in (1, 0):
            reply = client.pages.read(page, want_written=True)
            assert (reply.symbols == PAGES[page]).all()
            assert (reply.written == PAGES[page]).all()
        assert controlling.result(60) == [1, 0]
    client.display.report_page(None)


def test_an_upload_whose_caller_leaves_adds_no_page(start: Start) -> None:
    service, more = start(source=external(Lab())[0]), threading.Event()
    messages = [pb.UploadPagesRequest(levels=16), pb.UploadPagesRequest(symbols=PAGES.tobytes())]
    call = service.stub.UploadPages.future(until_told(messages, more), timeout=60)
    eventually(lambda: service.count("lightpage_calls_in_flight") == 1)
    call.cancel()
    more.set()
    eventually(lambda: service.count("lightpage_calls_in_flight") == 0)
    assert service.client.display.upload_pages(PAGES[:1], 16) == 0


def test_what_cannot_be_uploaded_is_named(start: Start) -> None:
    service = start(source=external(Lab())[0])
    levels = pb.UploadPagesRequest(levels=4)
    for messages in ([], [pb.UploadPagesRequest(symbols=b"a")], [levels] * 2, [levels, pb.UploadPagesRequest()]):
        answer = refused(lambda sent=messages: service.stub.UploadPages(iter(sent), timeout=20))  # type: ignore[misc]
        assert answer.reason == "MALFORMED"
    answer = refused(lambda: service.stub.ReportDisplay(pb.ReportDisplayRequest(), timeout=20))
    assert answer.reason == "INVALID_VALUE"


def test_more_than_the_service_holds_is_refused_as_it_comes() -> None:
    async def sent(*sizes: int, most: int = 8) -> tuple[int, np.ndarray]:
        async def messages() -> AsyncIterator[pb.UploadPagesRequest]:
            yield pb.UploadPagesRequest(levels=4)
            for size in sizes:
                yield pb.UploadPagesRequest(symbols=bytes(range(size)))

        return await uploaded_pages(messages(), (1, 2), most)

    levels, pages = asyncio.run(sent(2, 6))
    assert levels == 4
    np.testing.assert_array_equal(pages, [[[0, 1]], [[0, 1]], [[2, 3]], [[4, 5]]])
    for sizes, kind in (((2, 6, 2), LimitError), ((3,), PageError), ((0,), PageError), ((), PageError)):
        with pytest.raises(kind):
            asyncio.run(sent(*sizes))


def test_a_source_that_does_all_by_itself_says_so(service: Running) -> None:
    calls: list[Callable[[], object]] = [
        lambda: service.client.display.upload_pages(PAGES, 16),
        lambda: service.client.display.report_page(0),
        lambda: service.client.display.report_beams(signal=True, reference=True),
        lambda: next(service.client.display.watch(20.0)),
    ]
    for call in calls:
        with pytest.raises(NoSourceError):
            call()


def test_the_shots_of_a_source_are_in_the_metrics(start: Start) -> None:
    lab = Lab()
    source, stage = external(lab)
    source.modulator = stage
    service = start(source=source)
    service.client.display.upload_pages(PAGES, 16)
    service.client.pages.read(0)
    lab.plan = lambda: lab.cameras[0].edge()
    service.client.pages.read(1)
    assert service.count("lightpage_shots_total", outcome="TAKEN") == 2
    assert service.count("lightpage_shots_total", outcome="MISSING_FRAME") == 1
    assert service.plane.metrics.registry.get_sample_value("lightpage_saturated_share", {"camera": "I"}) is not None
