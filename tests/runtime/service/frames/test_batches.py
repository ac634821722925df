"""Pages of concurrent calls, of a stream and of a range are computed together; what befalls one is its own."""

from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace

import grpc
import numpy as np
import pytest

from lightpage.errors import FrameError
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.client.answers import RemotePage
from lightpage.runtime.client.pb.inference import open_inference_pb2_grpc as oip_grpc
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.decoding.batches import Batching
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.under_way import Phase
from tests.runtime import toy
from tests.runtime.conftest import begun
from tests.runtime.held_graph import LARGEST, HeldGraph
from tests.runtime.service.frames.test_inference import arrays, request_of
from tests.runtime.service.stage import Running, a_page, parts, refused
from tests.waiting import LIMIT_S, eventually


class Stage:
    """A service that computes pages together, and callers of it."""

    def __init__(self, decoder: Decoder) -> None:
        self.graph, self.batching = HeldGraph(decoder), Batching(LARGEST)
        self.service: Running = begun(self.graph.gathering(self.batching))
        self.service.plane.metrics.watch_batches(self.batching.pages, lambda: self.service.plane.together)
        self.pool = ThreadPoolExecutor(8)

    def count(self, phase: Phase) -> int:
        return self.batching.pages.count(phase)

    def inferred(self, pair: FramePair) -> np.ndarray:
        """The symbols, by the Open Inference Protocol."""
        stub = oip_grpc.GRPCInferenceServiceStub(self.service.channel())
        return arrays(stub.ModelInfer(request_of(pair, levels=16)))["symbols"]

    def decode(self, pair: FramePair) -> Future[RemotePage]:
        return self.pool.submit(self.service.client.frames.decode, pair, 16)

    @contextmanager
    def held(self) -> Iterator[None]:
        """A page is being computed within the `with` statement, alone."""
        first = self.decode(a_page()[1])
        eventually(lambda: self.count(Phase.RUNNING) == 1)
        yield
        self.graph.may_run.set()
        assert first.result(LIMIT_S) is not None


@pytest.fixture
def stage(decoder: Decoder) -> Iterator[Stage]:
    stage = Stage(decoder)
    yield stage
    stage.graph.may_run.set()
    stage.pool.shutdown()
    stage.service.end()


def test_pages_of_concurrent_calls_are_computed_together_and_one_is_refused_alone(stage: Stage) -> None:
    pages = [a_page(seed=seed) for seed in range(7)]
    shown = [pair for _, pair in pages]
    shown[2] = FramePair(shown[2].quadrature, shown[2].in_phase)
    with stage.held():
        other = stage.pool.submit(stage.inferred, shown.pop())
        replies = [stage.decode(pair) for pair in shown]
        eventually(lambda: stage.count(Phase.WAITING) == 7)
    assert isinstance(replies.pop(2).exception(LIMIT_S), FrameError)
    del pages[2]
    assert np.mean(other.result(LIMIT_S) == pages.pop()[0]) > 0.9
    for reply, (symbols, _) in zip(replies, pages, strict=True):
        assert np.mean(reply.result().symbols == symbols) > 0.9
    assert stage.batching.pages.runs == {1: 1, LARGEST: 1, 3: 1}
    assert stage.service.count("lightpage_batch_pages_bucket", le="2") == 1
    assert stage.service.count("lightpage_batch_pages_sum") == 8
    assert stage.service.count("lightpage_device_seconds_total", state="running") > 0
    assert stage.service.count("lightpage_stage_seconds_count", method="DecodeFrames", stage="queue") == 7


@pytest.mark.parametrize("call", ["a stream", "a range"])
def test_pages_of_one_call_are_computed_together_and_answered_in_their_order(stage: Stage, call: str) -> None:
    client, numbers = stage.service.client, range(6)
    written = [toy.symbols_of(16, number)[0] for number in numbers]
    shown = [toy.ToyDevice(seed=number).page(symbols, 16) for number, symbols in enumerate(written)]
    made = client.frames.decode_many(shown, 16) if call == "a stream" else client.pages.read_many(numbers)
    answers = stage.pool.submit(list, made)
    eventually(lambda: stage.count(Phase.RUNNING) + stage.count(Phase.WAITING) == len(shown))
    stage.graph.may_run.set()
    for symbols, found in zip(written, answers.result(LIMIT_S), strict=True):
        assert np.mean(found.symbols == symbols) > 0.9
    assert max(stage.batching.pages.runs) > 1


def test_a_caller_whose_time_is_up_holds_nobody_up(stage: Stage) -> None:
    with stage.held():
        other = stage.decode(a_page()[1])
        eventually(lambda: stage.count(Phase.WAITING) == 1)
        late = refused(lambda: stage.service.stub.DecodeFrames(parts(a_page()[1]), timeout=0.1))
        assert late.code is grpc.StatusCode.DEADLINE_EXCEEDED
        assert not other.done()
    assert other.result(LIMIT_S).symbols.shape == toy.PAGE


def test_a_page_in_a_run_ends_with_the_model_that_it_began_with(stage: Stage, decoder: Decoder) -> None:
    plane, slots = stage.service.plane, [stage.service.plane.decodes.count]
    with stage.held():
        begun_before = stage.decode(a_page()[1])
        eventually(lambda: stage.count(Phase.WAITING) == 1)
        plane.models.adopt(decoder.of_bundle(renamed(decoder, "toy-2")))  # it has no batches
        slots.append(plane.decodes.count)
    assert begun_before.result(LIMIT_S).model_version == decoder.version
    assert stage.decode(a_page()[1]).result(LIMIT_S).model_version == "toy-2"
    assert plane.decodes.busy == 0
    plane.models.adopt(stage.graph.gathering(stage.batching).of_bundle(renamed(decoder, "toy-3")))
    assert [*slots, plane.decodes.count] == [2 * LARGEST, plane.limits.concurrent_decodes, 2 * LARGEST]
    assert (plane.together, plane.ahead()) == (LARGEST, 2 * LARGEST)


def renamed(decoder: Decoder, version: str) -> Bundle:
    manifest = decoder.bundle.manifest.model_copy(update={"version": version})
    return replace(decoder.bundle, manifest=manifest)
