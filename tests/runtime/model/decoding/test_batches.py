"""Dynamic batching: who is computed with whom, and what becomes of a page whose run fails."""

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, cast
from unittest.mock import patch

import numpy as np
import pytest

from lightpage.errors import BundleError
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.decoding.batch_graph import BatchGraph, Constants, FrameBuffer, fewer
from lightpage.runtime.model.decoding.batches import KEPT, Batches, Batching, HeldConstants
from lightpage.runtime.model.decoding.page import Inference
from lightpage.runtime.model.decoding.under_way import Device, Phase, UnderWay
from lightpage.runtime.model.execution.page_graph import REGISTRATION
from lightpage.runtime.model.execution.session import BoundSession
from lightpage.runtime.model.execution.table_graph import TableGraph
from tests.clock import HandClock
from tests.waiting import eventually

PATIENT = 30.0


class Table:
    """A decoder's graph that is asked for its registration alone."""

    def __init__(self, shift: float = 0.0) -> None:
        self.registration = np.full((2, 2, 10), shift, np.float32)

    def value(self, name: str) -> np.ndarray:
        assert name == REGISTRATION
        return self.registration


class Graph:
    """Says of a page the number that its frame is full of; runs when it is let."""

    subject, pages = "bundle F: batch.onnx", 4

    def __init__(self, table: Table) -> None:
        self.constants_of_bundle = self.constants(table)
        self.runs: list[list[int]] = []
        self.may_run = threading.Event()
        self.may_run.set()
        self.fails: Callable[[list[int]], None] = lambda numbers: None

    def fit(self, pages: int) -> None:
        self.pages = 4

    def constants(self, table: Table, registration: np.ndarray | None = None) -> Constants:
        own = table.registration if registration is None else registration
        return Constants(own, cast(BoundSession, None), reach_px=5.0)

    def buffer(self) -> FrameBuffer:
        return FrameBuffer(self.pages, (1, 1), "uint8")

    def run(self, constants: Constants, buffer: FrameBuffer, pages: slice) -> list[Inference]:
        numbers = [int(number) for number in buffer.frames["in_phase"][pages, 0, 0]]
        self.runs.append(numbers)
        assert self.may_run.wait(PATIENT)
        self.fails(numbers)
        return [Inference(*[np.full(1, number, np.float32)] * 3) for number in numbers]


class Stage:
    """Batches of a graph, and callers of them."""

    def __init__(self) -> None:
        self.table, self.pages, self.clock = Table(), UnderWay(), HandClock()
        self.graph = Graph(self.table)
        self.batches = self.gathering()
        self.pool = ThreadPoolExecutor(10)

    def gathering(self) -> Batches:
        graph, table = cast(BatchGraph, self.graph), cast(TableGraph, self.table)
        return Batches(graph, table, Batching(8, 0.005, self.pages), self.clock)

    def infer(self, number: int, table: Table | None = None) -> int | None:
        """The number, None of a page that is to be computed alone."""
        frame = np.full((1, 1), number, np.uint8)
        found = self.batches.infer(cast(TableGraph, table or self.table), FramePair(frame, frame))
        return None if found is None else int(found.p[0])

    @contextmanager
    def held(self, *numbers: int) -> Iterator[list[Future[int | None]]]:
        """Page 0 runs while these others come; they are computed behind the `with` statement."""
        self.graph.may_run.clear()
        first = self.pool.submit(self.infer, 0)
        eventually(lambda: self.graph.runs == [[0]])
        others = [self.pool.submit(self.infer, number) for number in numbers]
        eventually(lambda: self.pages.count(Phase.WAITING) == len(numbers))
        yield others
        self.graph.may_run.set()
        assert first.result(PATIENT) == 0


@pytest.fixture
def stage() -> Iterator[Stage]:
    stage = Stage()
    yield stage
    stage.pool.shutdown()


def test_a_page_alone_is_computed_at_once(stage: Stage) -> None:
    assert [stage.infer(number) for number in (7, 8)] == [7, 8]
    assert stage.graph.runs == [[7], [8]]


def test_pages_that_come_while_a_run_is_on_are_computed_together(stage: Stage) -> None:
    with stage.held(*range(1, 8)) as others:
        pass
    assert [page.result(PATIENT) for page in others] == list(range(1, 8))
    assert [len(run) for run in stage.graph.runs] == [1, 4, 3]
    assert stage.pages.runs == {1: 1, 4: 1, 3: 1}


def test_a_run_waits_for_a_page_whose_frames_are_being_checked(stage: Stage) -> None:
    with stage.batches.under_way():
        other = stage.pool.submit(stage.infer, 1)
        eventually(lambda: stage.pages.count(Phase.WAITING) == 1)
        assert stage.infer(2) == 2
    assert other.result(PATIENT) == 1
    assert [sorted(run) for run in stage.graph.runs] == [[1, 2]]


def test_a_run_waits_for_no_page_that_waits_for_something_else(stage: Stage) -> None:
    with stage.batches.under_way():
        stage.batches.put_off()
        assert stage.pool.submit(stage.infer, 1).result(PATIENT) == 1


def test_a_run_waits_no_longer_than_is_set(stage: Stage) -> None:
    with stage.batches.under_way():
        page = stage.pool.submit(stage.infer, 1)
        stage.clock.until_somebody_waits()
        assert not page.done()
        stage.clock.advance(0.005)
        assert page.result(PATIENT) == 1


def test_an_error_is_that_of_every_page_of_its_run_and_of_no_other(stage: Stage) -> None:
    def fail(numbers: list[int]) -> None:
        if 3 in numbers:
            raise BundleError("run", "nothing", "an answer")

    stage.graph.fails = fail
    with stage.held(3, 4, 5) as others:
        pass
    errors = [page.exception(PATIENT) for page in others]
    assert {type(error) for error in errors} == {BundleError}
    assert len({id(error) for error in errors}) == len(errors)
    assert stage.infer(6) == 6


def test_where_memory_is_short_runs_are_smaller_from_then_on(stage: Stage, caplog: pytest.LogCaptureFixture) -> None:
    def fail(numbers: list[int]) -> None:
        if len(numbers) > 1:
            raise RuntimeError("Failed to allocate memory for requested buffer of size 9")

    stage.graph.fails = fail
    with stage.held(1, 2, 3, 4) as others:
        pass
    assert sorted(page.result(PATIENT) for page in others) == [1, 2, 3, 4]
    assert stage.batches.largest == 1
    assert stage.pages.runs == {1: 5}
    assert "memory" in caplog.text
    assert [fewer(pages) for pages in (16, 12, 6, 5, 3, 2)] == [8, 8, 4, 4, 2, 1]
    stage.graph.fails = lambda numbers: None
    stage.gathering()  # another model comes and goes
    assert stage.infer(6) == 6
    assert stage.batches.largest == 4


def test_only_pages_of_the_same_constants_are_computed_together(stage: Stage) -> None:
    other = Table(shift=9.0)
    eventually(lambda: stage.infer(1, other) == 1)  # alone until its constants are made
    stage.graph.runs.clear()
    stage.graph.may_run.clear()
    pages = [stage.pool.submit(stage.infer, number, table) for number, table in enumerate([None, other, None, other])]
    eventually(lambda: stage.pages.count(Phase.WAITING) + stage.pages.count(Phase.RUNNING) == 4)
    stage.graph.may_run.set()
    assert [page.result(PATIENT) for page in pages] == [0, 1, 2, 3]
    assert all(len({number % 2 for number in run}) == 1 for run in stage.graph.runs)


def holding(table: Any) -> HeldConstants:
    """Constants, each made before anything else goes on."""
    return HeldConstants(cast(BatchGraph, Graph(table)), table, lambda work: work())


def test_few_constants_are_held_and_those_in_use_stay() -> None:
    tables: Any = [Table(9.0 * number) for number in range(KEPT + 1)]
    held = holding(tables[0])
    found = [held.of(table, None) for table in tables]
    assert [each is None for each in found] == [*[False] * KEPT, True]
    for _ in range(100):
        assert held.of(tables[0], None) is not None
    assert held.of(tables[-1], None) is not None
    assert held.of(tables[1], None) is not None  # made again
    tables = [Table(9.0 * number) for number in range(KEPT)]  # in place of those that are gone
    assert all(held.of(table, None) is not None for table in tables)


def test_pages_go_alone_until_their_constants_are_made(stage: Stage, caplog: pytest.LogCaptureFixture) -> None:
    tables, work = cast(Any, [Table(9.0 * number) for number in range(KEPT + 1)]), list[Callable[[], None]]()
    held = HeldConstants(cast(BatchGraph, Graph(tables[0])), tables[0], work.append)
    assert [held.of(table, None) for table in tables[1:] * 2] == [None] * 2 * KEPT
    assert len(work) == KEPT - 1  # those that are being made take room
    with patch.object(Graph, "constants", side_effect=MemoryError):
        work.pop(0)()
    assert caplog.records
    for made in work:
        made()
    assert [held.of(table, None) is None for table in tables] == [False, True, False, False, True]
    with patch.object(HeldConstants, "of", return_value=None):
        assert stage.infer(1) is None
    assert stage.pages.alone == 1


def test_constants_follow_an_image_that_leaves_their_reach() -> None:
    table: Any = Table()
    held = holding(table)
    near, far = (np.zeros((2, 2, 10), np.float32) for _ in range(2))
    near[..., 0], far[..., 0] = 2, 20
    first, second = held.of(table, near), held.of(table, far)
    assert first is not None
    assert second is not None
    assert first[0] is not second[0]
    assert (first[1].max(), second[1].max()) == (2, 0)


def test_what_the_device_does_is_told_by_the_pages_under_way() -> None:
    now = 0.0
    pages = UnderWay(lambda: now)
    for phase, other in [
        (None, None),
        (Phase.COMING, None),
        (Phase.WAITING, Phase.BEHIND),
        (Phase.RUNNING, Phase.COMING),
        (Phase.BEHIND, None),
    ]:
        pages.move(phase, 1)
        pages.move(other, 2)
        now += 1
    expected = {Device.IDLE: 1, Device.FRAMES: 2, Device.RUNNING: 1, Device.POST_PROCESSING: 1}
    assert pages.seconds() == expected
