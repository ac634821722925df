"""The Python client has all that the contract offers to one who decodes and reads, bytes of users among it."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lightpage.codec.page_bytes import Loss
from lightpage.errors import (
    BundleError,
    FrameError,
    InvalidInputError,
    LightpageError,
    LimitError,
    LostShotError,
    OtherModelError,
    PageError,
    Reason,
    SourceError,
)
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.client.answers import RemotePage
from lightpage.runtime.client.outgoing import KnownPilots
from lightpage.runtime.device.acquisition.source import Shot
from lightpage.runtime.service.caller import Caller
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.pages.reading import read_data
from tests.runtime import coded, toy
from tests.runtime.service.stage import Running, Start, a_page

MASK = np.ones(toy.PROFILE.page_shape, bool)


def test_pairs_that_fail_on_the_callers_side_end_the_call_with_their_error(service: Running) -> None:
    def pairs() -> Iterator[FramePair]:
        yield a_page()[1]
        raise KeyError("mine")

    with pytest.raises(KeyError):
        list(service.client.frames.decode_many(pairs()))
    good = a_page()[1].quadrature
    for bad in (good[1:], good.astype(np.uint16), good[0]):
        with pytest.raises(FrameError):
            list(service.client.frames.decode_many([replace(a_page()[1], quadrature=bad)]))


def test_many_pages_of_the_source_in_one_call(start: Start) -> None:
    service = start()

    def lost(shot: Shot) -> Shot:
        if shot.page_index == 5:
            raise LostShotError("page 5", "no frame", "one", Reason.MISSING_FRAME)
        return shot

    service.reading(lost)
    first, gone, last = service.client.pages.read_many([2, 5, 1], want_written=True)
    assert isinstance(gone, LostShotError)
    assert gone.reason is Reason.MISSING_FRAME
    for page, number in ((first, 2), (last, 1)):
        assert isinstance(page, RemotePage)
        assert (page.page, page.written is None) == (number, False)
    assert [one.page for one in service.client.pages.read_many(count=2) if isinstance(one, RemotePage)] == [0, 1]


@pytest.mark.parametrize(
    ("call", "field"),
    [
        (lambda client: client.pages.read(-1), "page"),
        (lambda client: client.frames.decode(a_page()[1], frame_id=2**64), "frame_id"),
        (lambda client: client.frames.decode(a_page()[1], pilots=KnownPilots(MASK, 256 * MASK, 0)), "pilots"),
        (lambda client: client.models.activate("\ud800"), "version"),
        (lambda client: client.jobs.recalibrate(pages=[-1]), "pages"),
        (lambda client: client.jobs.start(pages=[1, 2], recording="known.h5"), "pages to recalibrate with"),
        (lambda client: list(client.pages.read_data(0, 2**40)), "pages"),
    ],
)
def test_what_no_message_can_hold_is_named(call: Any, field: str, service: Running) -> None:
    with pytest.raises(InvalidInputError) as error:
        call(service.client)
    assert error.value.subject == field


@pytest.mark.parametrize(
    ("call", "place"),
    [
        (lambda client: client.decode(a_page()[1], 16), "frames.decode"),
        (lambda client: client.read_page(3), "pages.read"),
        (lambda client: client.recalibrate(recording="none.h5"), "jobs.recalibrate"),
        (lambda client: client.rollback("none"), "models.roll_back"),
        (lambda client: client.models(), "models.list"),
    ],
)
def test_a_method_of_version_0_1_0_works_and_names_its_new_place(call: Any, place: str, service: Running) -> None:
    with pytest.warns(DeprecationWarning, match=place), suppress(SourceError, OtherModelError):
        assert call(service.client)
    with pytest.raises(AttributeError):
        _ = service.client.no_such_name  # type: ignore[attr-defined]


Serve = Callable[..., tuple[Running, np.ndarray]]


@pytest.fixture
def serve(start: Start, tmp_path: Path) -> Serve:
    """Starts a service whose source shows pages, some of them spoilt; returns it and the pages' symbols."""

    def begin(spoilt: dict[int, coded.Spoil] | None = None, with_code: bool = True) -> tuple[Running, np.ndarray]:
        bundle = coded.bundle(tmp_path / "toy.zip")
        pages = coded.pages(bundle, tmp_path)
        own = bundle if with_code else coded.bundle(tmp_path / "plain.zip", None)
        return start(own, source=coded.ShownPages(pages, spoilt)), pages

    return begin


def test_a_page_carries_its_bytes_when_asked(serve: Serve) -> None:
    service, pages = serve({2: coded.half_lost})
    client = service.client
    pair = toy.ToyDevice(noise=8.0).page(pages[1], 32, 0.3)
    size = client.describe().user_bytes_per_page
    assert size == service.plane.models.current.decoder.page_codec.user_bytes
    for page in (client.frames.decode(pair, 0, user_data=True), client.pages.read(1, user_data=True)):
        found = page.user_data
        assert found is not None
        assert found.data == coded.CONTENT[size : 2 * size]
        assert found.header is not None
        assert (found.header.volume, found.header.page, found.header.volume_bytes) == (9, 1, 1000)
        assert (found.loss, page.levels) == (None, 32)
        assert (found.file.data_pages, found.file.parity_pages) == (3, 2)
        assert found.margin_bits > 0
    assert client.frames.decode(pair, 32).user_data is None
    assert service.count("lightpage_margin_bits") > 0
    lost = client.pages.read(2, user_data=True).user_data  # it has symbols and no bytes
    assert lost is not None
    assert (lost.data, lost.loss, lost.margin_bits > 0) == (None, Loss.BODY, False)
    assert service.count("lightpage_data_pages_total", loss="body") == 1
    assert service.count("lightpage_data_pages_total", loss="none") == 2


def test_what_cannot_be_asked_for_is_named(serve: Serve) -> None:
    client = serve()[0].client
    cases: list[tuple[Callable[[], object], type[LightpageError], str]] = [
        (lambda: client.pages.read(0, 16, user_data=True), InvalidInputError, "levels"),
        (lambda: client.pages.read(0, 16, want_fase=True), InvalidInputError, "option of a page"),
        (lambda: list(client.pages.read_data(0, 0)), InvalidInputError, "pages"),
        (lambda: list(client.pages.read_data(0, 4097)), LimitError, "pages"),
        (lambda: list(client.pages.read_data((1 << 32) - 1, 2)), InvalidInputError, "first_page"),
        (lambda: list(client.pages.read_data(99, 1)), PageError, "page of toy:pages"),
    ]
    for call, kind, subject in cases:
        with pytest.raises(kind) as error:
            call()
        assert error.value.subject == subject


def test_a_model_without_a_code_says_so(serve: Serve) -> None:
    client = serve(with_code=False)[0].client
    assert (client.describe().code_toml, client.describe().user_bytes_per_page) == ("", 0)
    for call in (lambda: client.pages.read(0, user_data=True), lambda: list(client.pages.read_data(0, 2))):
        with pytest.raises(BundleError) as error:
            call()
        assert error.value.subject == "bundle plain.zip: code"


def test_a_range_is_streamed_and_lost_pages_are_restored(serve: Serve) -> None:
    service, pages = serve({0: coded.dark, 1: coded.half_lost, 6: coded.half_lost, 7: coded.dark, 8: coded.dark})
    size = service.client.describe().user_bytes_per_page
    found = list(service.client.pages.read_data(0, 1000))  # the range ends with the source
    assert [each.page for each in found if each.page is not None] == list(range(len(pages)))
    assert found[0].user_data.loss == Loss.OPTICS
    assert found[0].error
    restored = {each.user_data.header.page: each.user_data.data for each in found if each.page is None}
    assert restored == {0: coded.CONTENT[:size], 1: coded.CONTENT[size : 2 * size]}  # of group 1 too many are lost
    assert found[-1].page is None  # restored pages follow at the end
    read = {each.user_data.header.page: each.user_data.data for each in found if each.user_data.data is not None}
    assert read[2] == coded.CONTENT[2 * size : 3 * size]


def test_files_whose_pages_take_turns_are_restored(serve: Serve) -> None:
    service, pages = serve()
    plane = service.plane
    folder = plane.models.current.decoder.bundle.path.parent / "other"
    folder.mkdir()
    other = coded.pages(coded.bundle(folder / "toy.zip"), folder, b"y" * 400)
    mixed = [page for pair in zip(pages[:5], other[:5], strict=True) for page in pair]
    source = coded.ShownPages(mixed, {2: coded.half_lost, 3: coded.half_lost})
    both = DataPlane(plane.models, source)
    found = list(read_data(both, 0, 10, Caller()))
    restored = [(page.found.header.page, page.found.file.checksum) for page in found if page.source_page is None]
    assert len(restored) == 2
    assert {number for number, _ in restored} == {1}
    assert len({checksum for _, checksum in restored}) == 2
    assert all(page.model_version == "toy-1" for page in found)
