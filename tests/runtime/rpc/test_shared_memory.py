"""Shared memory: frames in it are decoded as those that are sent, and what a client does there harms nobody."""

from __future__ import annotations

import secrets
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import grpc
import numpy as np
import pytest

from lightpage.errors import FrameError, InvalidInputError, LightpageError
from lightpage.recording.frame_pair import FramePair
from runtime.pb.lightpage.v1 import lightpage_pb2 as pb
from runtime.service.receiver import PairReceiver
from runtime.service.shared_memory import SharedMemory
from runtime.wire.shared_memory import HANDLE_BYTES, memory_path
from tests.runtime import toy
from tests.runtime.rpc.conftest import begun
from tests.runtime.rpc.stage import Refused, Running, Start, a_page, header, refused
from tests.waiting import eventually

PAIR = 2 * toy.SHAPE[0] * toy.SHAPE[1]
SYMBOLS, FRAMES = a_page()


@pytest.fixture(scope="module")
def shared(decoder: object, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """A service at a Unix socket that shares up to four pairs of memory in three regions."""
    address = f"unix:{tmp_path_factory.mktemp('shared')}/s"
    service = begun(decoder, address=address)  # type: ignore[arg-type]
    with SharedMemory(memory_path(address), 4 * PAIR, 3, silence_s=60) as memory:
        service.plane.shared = memory
        yield service
    service.end()


def asked(region: bytes, offset: int = 0) -> pb.DecodeFramesRequest:
    return pb.DecodeFramesRequest(header=header(shared=pb.SharedFrames(region=region, offset=offset)))


def fails(service: Running, *messages: pb.DecodeFramesRequest) -> Refused:
    return refused(lambda: service.stub.DecodeFrames(iter(messages), timeout=20))


def test_a_pair_in_shared_memory_is_decoded_as_one_that_is_sent(shared: Running) -> None:
    sent = shared.client.decode(FRAMES, 16)
    with shared.client.share_memory() as memory:
        assert memory.size == PAIR
        pages = [shared.client.decode(FRAMES, 16, memory=memory)]
        pages.append(shared.client.decode(memory.frames(toy.SHAPE, "uint8"), 16, memory=memory))
    for page in pages:
        assert (page.symbols == SYMBOLS).all()
        np.testing.assert_array_equal(page.confidence, sent.confidence)
    assert shared.plane.received.used == 0
    assert shared.client.describe().limits.shared_bytes == 4 * PAIR  # type: ignore[union-attr]


def test_pairs_may_lie_anywhere_in_their_region(shared: Running) -> None:
    other, second = a_page(seed=4)
    with shared.client.share_memory(2 * PAIR + 7) as memory:
        for offset, pair in ((7, FRAMES), (7 + PAIR, second)):
            inside = memory.frames(toy.SHAPE, "uint8", offset)
            inside.in_phase[...], inside.quadrature[...] = pair.in_phase, pair.quadrature
        assert (shared.client.decode(inside, 16, memory=memory).symbols == other).all()
        first = shared.stub.DecodeFrames(iter([asked(memory.handle, 7)]), timeout=20)
        assert first.symbols == SYMBOLS.tobytes()
        for offset in (PAIR + 8, 2 * PAIR, 1 << 40, (1 << 64) - 1):
            answer = fails(shared, asked(memory.handle, offset))
            assert (answer.code, answer.subject) == (grpc.StatusCode.INVALID_ARGUMENT, "header.shared.offset")


def test_a_pair_that_lies_there_the_other_way_round_is_turned(shared: Running) -> None:
    with shared.client.share_memory() as memory:
        inside = memory.frames(toy.SHAPE, "uint8")
        inside.in_phase[...], inside.quadrature[...] = FRAMES.quadrature, FRAMES.in_phase
        page = shared.client.decode(FramePair(inside.quadrature, inside.in_phase), 16, memory=memory)
        np.testing.assert_array_equal(inside.in_phase, FRAMES.in_phase)
        np.testing.assert_array_equal(inside.quadrature, FRAMES.quadrature)
    assert (page.symbols == SYMBOLS).all()


def test_many_pages_of_one_call_may_lie_there(shared: Running) -> None:
    with shared.client.share_memory() as memory:
        memory.write(FRAMES)
        messages = [asked(memory.handle), asked(memory.handle, 1), asked(memory.handle)]
        replies = list(shared.stub.DecodePages(iter(messages), timeout=20))
    assert [reply.WhichOneof("outcome") for reply in replies] == ["decoded", "refused", "decoded"]
    assert replies[2].decoded.symbols == SYMBOLS.tobytes()


def test_unknown_foreign_and_dropped_regions_are_refused_alike(shared: Running) -> None:
    with shared.client.share_memory() as memory:
        memory.write(FRAMES)
        handle = memory.handle
        answer = fails(shared, asked(handle), pb.DecodeFramesRequest(chunk=b"x"))  # pixels behind shared ones
        assert answer.reason == "FRAME_FORMAT"
    eventually(lambda: fails(shared, asked(handle)).subject == "header.shared.region")
    told = set()
    for region in (handle, handle[:-1], secrets.token_bytes(HANDLE_BYTES), b"", b"x" * 100_000):
        answer = fails(shared, asked(region))
        told.add((answer.code, answer.text))
    assert [code for code, _ in told] == [grpc.StatusCode.INVALID_ARGUMENT]


def test_a_call_that_is_cancelled_while_it_is_copied_gives_its_memory_back(
    shared: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    copying, go_on, add = threading.Event(), threading.Event(), PairReceiver.add

    def slow(receiver: PairReceiver, chunk: bytes | memoryview) -> None:
        copying.set()
        go_on.wait(60)
        add(receiver, chunk)

    monkeypatch.setattr(PairReceiver, "add", slow)
    with shared.client.share_memory() as memory:
        memory.write(FRAMES)
        call = shared.stub.DecodeFrames.future(iter([asked(memory.handle)]), timeout=60)
        assert copying.wait(60)
        call.cancel()
        eventually(lambda: not shared.count("lightpage_calls_in_flight"))
        go_on.set()
        monkeypatch.undo()
        assert (shared.client.decode(FRAMES, 16, memory=memory).symbols == SYMBOLS).all()
    eventually(lambda: shared.plane.received.used == 0)


def test_frames_that_do_not_fit_are_refused_before_they_are_written(shared: Running) -> None:
    with shared.client.share_memory(PAIR - 1) as memory:
        with pytest.raises(InvalidInputError):
            shared.client.decode(FRAMES, 16, memory=memory)
        with pytest.raises(FrameError):
            shared.client.decode(replace(FRAMES, in_phase=FRAMES.in_phase[0]), 16, memory=memory)


def test_a_service_without_shared_memory_says_so(start: Start, service: Running, tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError) as error:
        service.client.share_memory()
    assert "unix:PATH" in error.value.expected
    alone = start(address=f"unix:{tmp_path}/s")
    with pytest.raises(LightpageError) as refusal:
        alone.client.share_memory()
    assert "--shared-memory" in str(refusal.value)
    assert fails(alone, asked(b"x")).subject == "header.shared"
