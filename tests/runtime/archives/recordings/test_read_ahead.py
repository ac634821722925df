"""What is read while the caller works: each page in its place, one ahead, its error with it; pages that were seen."""

import threading
from pathlib import Path

import numpy as np
import pytest

from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import hash_frames
from lightpage.runtime.archives.recordings.evaluation import was_seen
from lightpage.runtime.archives.recordings.read_ahead import read_ahead
from lightpage.runtime.model.decoding.decoder import Decoder
from tests.runtime import toy
from tests.waiting import LIMIT_S


def test_the_next_page_is_read_while_the_caller_works_and_no_further() -> None:
    begun = [threading.Event() for _ in range(5)]

    def read(index: int) -> str:
        begun[index].set()
        return f"page {index}"

    for index, page in read_ahead(read, range(5)):
        assert page.result(LIMIT_S) == f"page {index}"
        if index < 4:
            assert begun[index + 1].wait(LIMIT_S)  # while this page is still in the caller's hands
        assert not any(event.is_set() for event in begun[index + 2 :])


def test_a_page_that_cannot_be_read_says_so_in_its_place() -> None:
    def read(index: int) -> int:
        return 6 // (index - 1)

    failures = [page.exception(LIMIT_S) for _, page in read_ahead(read, range(3))]
    assert [type(failure) for failure in failures] == [type(None), ZeroDivisionError, type(None)]


def test_whoever_stops_early_waits_for_no_page_that_has_not_begun() -> None:
    read: list[int] = []
    first, go = threading.Event(), threading.Event()

    def slow(index: int) -> int:
        read.append(index)
        first.set()
        assert go.wait(LIMIT_S)
        return index

    pages = read_ahead(slow, range(4))
    next(pages)
    assert first.wait(LIMIT_S)
    threading.Timer(0.05, go.set).start()
    pages.close()
    assert read == [0]


@pytest.mark.parametrize(("trained", "saved"), [(("u1", "u1"), (">u2", "u1")), (("u1", "u2"), ("u2", "u2"))])
def test_a_page_is_known_again_in_whichever_type_its_counts_are_stored(
    trained: tuple[str, str], saved: tuple[str, str], tmp_path: Path
) -> None:
    counts = np.random.default_rng(0).integers(0, 256, (2, *toy.SHAPE))
    then, now = (FramePair(counts[0].astype(a), counts[1].astype(b)) for a, b in (trained, saved))
    decoder = Decoder.load(toy.write_toy_bundle(tmp_path / "t.zip", trained_pages=[hash_frames(then)]), threads=1)
    assert was_seen(decoder, now)
    assert not was_seen(decoder, FramePair(now.quadrature, now.in_phase))
