"""A controller uploads pages, shows them when they are wanted, and says so."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import grpc
import numpy as np
import pytest

from lightpage.errors import InvalidInputError, LimitError, PageError
from runtime.acquisition.camera_source import CameraSource, Exposures
from runtime.acquisition.page_store import PageStore
from runtime.acquisition.source import FrameSource
from runtime.bundle.bundle import Bundle
from runtime.client.client import LightpageClient
from runtime.decoding.decoder import Decoder
from runtime.errors import LostShotError, Reason, SourceError
from runtime.modulator.external import ExternalBeams, ExternalModulator
from runtime.pb.lightpage.v1 import lightpage_pb2 as pb
from runtime.pb.lightpage.v1 import lightpage_pb2_grpc as pb_grpc
from runtime.rpc.server import LightpageServer
from runtime.service.dataplane import DataPlane
from runtime.service.recalibrator import Recalibrator
from runtime.service.registry import ModelRegistry
from tests.runtime import toy
from tests.runtime.acquisition.lab import PAIRING, Lab, LabModulator

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


class Serve:
    def __init__(self, bundle: Path, source: FrameSource) -> None:
        plane = DataPlane(ModelRegistry(Decoder(Bundle.open(bundle), threads=1)), source)
        self.plane = plane
        self.server = LightpageServer(plane, Recalibrator(plane, toy.fit_references)).start()
        self.client = LightpageClient(self.server.target, timeout_s=20)


@pytest.fixture
def serve(toy_zip: Path) -> Iterator[type[Serve]]:
    running: list[Serve] = []

    class Started(Serve):
        def __init__(self, source: FrameSource) -> None:
            super().__init__(toy_zip, source)
            running.append(self)

    yield Started  # type: ignore[misc]
    for service in running:
        service.client.close()
        service.server.stop(0.5)


def test_a_controller_shows_what_it_has_uploaded(serve: type[Serve]) -> None:
    lab = Lab()
    source, stage = external(lab)
    client = serve(source).client  # type: ignore[call-arg,arg-type]
    assert client.upload_pages(PAGES[:1], 16) == 0
    assert client.upload_pages(PAGES[1], 16) == 1
    seen: list[int] = []

    def control() -> None:
        with LightpageClient(client.target, timeout_s=20) as mine:
            for order in mine.display_orders(15.0):
                if order.page is not None:
                    seen.append(order.page)
                    stage.show(PAGES[order.page], 16, order.page, 1.0)
                    mine.page_shown(order.page)
                if len(seen) == 2:
                    return

    thread = threading.Thread(target=control)
    thread.start()
    for page in (1, 0):
        reply = client.read_page(page, want_written=True)
        assert (reply.symbols == PAGES[page]).all()
        assert reply.written is not None
        assert (reply.written == PAGES[page]).all()
    thread.join(20)
    assert seen == [1, 0]
    client.page_shown(None)


def test_an_upload_whose_caller_leaves_adds_no_page(serve: type[Serve]) -> None:
    service = serve(external(Lab())[0])  # type: ignore[call-arg,arg-type]
    sent, open_end = threading.Event(), threading.Event()

    def all_but_the_end() -> Iterator[pb.UploadPagesRequest]:
        yield pb.UploadPagesRequest(levels=16)
        yield pb.UploadPagesRequest(symbols=PAGES.tobytes())
        sent.set()
        open_end.wait(20)

    with grpc.insecure_channel(service.server.target) as channel:
        stub = pb_grpc.LightpageStub(channel)  # type: ignore[no-untyped-call]
        call = stub.UploadPages.future(all_but_the_end(), timeout=20)
        assert sent.wait(10)
        time.sleep(0.2)  # for the pages to arrive
        call.cancel()
        open_end.set()
        with pytest.raises(grpc.FutureCancelledError):
            call.result(10)

        def failing() -> Iterator[pb.UploadPagesRequest]:
            yield pb.UploadPagesRequest(levels=16)
            yield pb.UploadPagesRequest(symbols=PAGES.tobytes())
            time.sleep(0.2)
            raise ValueError

        with pytest.raises(grpc.RpcError):
            stub.UploadPages(failing(), timeout=20)
        assert service.client.upload_pages(PAGES[:1], 16) == 0


def test_beams_are_moved_by_the_controller_too(serve: type[Serve]) -> None:
    lab = Lab()
    source, stage = external(lab)
    client = serve(source).client  # type: ignore[call-arg,arg-type]

    def control() -> None:
        with LightpageClient(client.target, timeout_s=20) as mine:
            moved = 0
            for order in mine.display_orders(15.0):
                if order.beams is not None:
                    stage.let_through(signal=order.beams[0], reference=order.beams[1])
                    mine.beams_set(signal=order.beams[0], reference=order.beams[1])
                    moved += 1
                if moved == 2:
                    return

    thread = threading.Thread(target=control)
    thread.start()
    references = source.references()
    thread.join(20)
    assert (references.in_phase == toy.ToyDevice().references().in_phase).all()


def test_a_controller_that_says_nothing_costs_its_page(serve: type[Serve]) -> None:
    source, _ = external(Lab())
    service = serve(source)  # type: ignore[call-arg,arg-type]
    service.client.upload_pages(PAGES, 16)
    with (
        LightpageClient(service.client.target, timeout_s=1.5) as hasty,
        pytest.raises(Exception, match=r"on display|deadline") as raised,
    ):
        hasty.read_page(0)
    if isinstance(raised.value, LostShotError):
        assert raised.value.reason is Reason.NOT_ON_DISPLAY


def test_what_cannot_be_uploaded_is_named(serve: type[Serve]) -> None:
    source, _ = external(Lab())
    client = serve(source).client  # type: ignore[call-arg,arg-type]
    client.upload_pages(PAGES, 16)
    with pytest.raises(InvalidInputError, match="16, as the pages before"):
        client.upload_pages(PAGES % 4, 4)
    with pytest.raises(PageError, match="whole pages"):
        client.upload_pages(PAGES[:, :-1], 16)
    with pytest.raises(PageError):
        client.upload_pages(np.full_like(PAGES, 200), 16)
    with pytest.raises(PageError, match="none"):
        client.upload_pages(PAGES[:0], 16)
    source.pages.most_bytes = 2 * PAGES.nbytes - 1
    with pytest.raises(LimitError):
        client.upload_pages(PAGES, 16)
    assert len(source.pages) == 2
    with grpc.insecure_channel(client.target) as channel:
        stub = pb_grpc.LightpageStub(channel)
        for messages in ([], [pb.UploadPagesRequest(symbols=b"a")], [pb.UploadPagesRequest(levels=4)] * 2):
            with pytest.raises(grpc.RpcError) as raised:
                stub.UploadPages(iter(messages), timeout=10)
            assert raised.value.code() == grpc.StatusCode.INVALID_ARGUMENT
        with pytest.raises(grpc.RpcError) as raised:
            stub.ReportDisplay(pb.ReportDisplayRequest(), timeout=10)
        assert raised.value.code() == grpc.StatusCode.INVALID_ARGUMENT


def test_a_source_that_does_all_by_itself_says_so(serve: type[Serve]) -> None:
    client = serve(toy.ToySource(toy.ToyDevice())).client  # type: ignore[call-arg,arg-type]
    with pytest.raises(SourceError, match="modulator"):
        client.upload_pages(PAGES, 16)
    with pytest.raises(SourceError, match="external"):
        client.page_shown(0)
    with pytest.raises(SourceError, match="external"):
        client.beams_set(signal=True, reference=True)
    with pytest.raises(SourceError, match="external"):
        next(client.display_orders(5.0))


def test_the_shots_of_a_source_are_in_the_metrics(serve: type[Serve]) -> None:
    lab = Lab()
    source, stage = external(lab)
    source.modulator = stage
    service = serve(source)  # type: ignore[call-arg,arg-type]
    service.client.upload_pages(PAGES, 16)
    service.client.read_page(0)
    lab.plan = lambda: lab.cameras[0].edge()
    service.client.read_page(1)
    sample = service.plane.metrics.registry.get_sample_value
    assert sample("lightpage_shots_total", {"outcome": "TAKEN"}) == 2
    assert sample("lightpage_shots_total", {"outcome": "MISSING_FRAME"}) == 1
    assert sample("lightpage_saturated_share", {"camera": "I"}) is not None
