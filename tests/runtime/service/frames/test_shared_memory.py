"""Shared memory: frames in it are decoded as those that are sent, and what a client does there harms nobody."""

import fcntl
import os
import secrets
import socket
import threading
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import grpc
import numpy as np
import pytest

from lightpage.errors import FrameError, InvalidInputError, LightpageError
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.shared_memory import HANDLE_BYTES, SIZE, memory_path
from lightpage.runtime.client.shared_memory import SharedMemory as ClientMemory
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.service.frames.frames import PairReceiver
from lightpage.runtime.service.shared_memory import Region, SharedMemory
from tests.runtime import toy
from tests.runtime.conftest import begun
from tests.runtime.service.stage import Refused, Running, Start, a_page, header, refused
from tests.waiting import eventually

PAIR = 2 * toy.SHAPE[0] * toy.SHAPE[1]
SYMBOLS, FRAMES = a_page()
MOST = 4000


@pytest.fixture
def target(tmp_path: Path) -> Iterator[str]:
    """Where up to 4000 bytes of memory in three regions are shared."""
    with SharedMemory(memory_path(f"unix:{tmp_path}/s"), MOST, 3, silence_s=0.2):
        yield f"unix:{tmp_path}/s"


def all_is_free(target: str) -> bool:
    try:
        ClientMemory(target, MOST).close()
    except LightpageError:
        return False
    return True


def test_a_region_that_is_dropped_while_it_is_read_stays_until_then() -> None:
    region = Region(1000)
    with region.reading(0, 1000) as view:
        region.drop()
        region.drop()
        assert bytes(view) == bytes(1000)
        with pytest.raises(InvalidInputError) as error, region.reading(0, 1):
            pass
    assert error.value.subject == "header.shared.region"
    with pytest.raises(InvalidInputError) as error, Region(1000).reading(1, 1000):
        pass
    assert (error.value.subject, error.value.got) == ("header.shared.offset", "1")


def test_a_client_cannot_change_the_size_of_its_region(target: str) -> None:
    with socket.socket(socket.AF_UNIX) as connection:
        connection.connect(memory_path(target))
        connection.sendall(SIZE.pack(1000))
        answer, (descriptor,), _, _ = socket.recv_fds(connection, 100, 1)
        try:
            for size in (0, 999, 1001):
                with pytest.raises(PermissionError):
                    os.ftruncate(descriptor, size)
            with pytest.raises(PermissionError):
                fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, fcntl.F_SEAL_WRITE)
        finally:
            os.close(descriptor)
        assert len(answer) == 1 + HANDLE_BYTES


def test_memory_is_bounded(target: str) -> None:
    for size in (MOST + 1, (1 << 63) - 1):
        with pytest.raises(LightpageError):
            ClientMemory(target, size)
    with ClientMemory(target, 3000), pytest.raises(LightpageError):
        ClientMemory(target, 1001)
    eventually(lambda: all_is_free(target))
    regions = [ClientMemory(target, 1) for _ in range(3)]
    with pytest.raises(LightpageError):
        ClientMemory(target, 1)
    for region in regions:
        region.close()
    eventually(lambda: all_is_free(target))
    for size in (-1, 1 << 63):
        with pytest.raises(InvalidInputError) as impossible:
            ClientMemory(target, size)
        assert impossible.value.subject == "size of shared memory"


@pytest.mark.parametrize("said", [b"", b"\x01\x02", SIZE.pack(1000) + b"more"])
def test_whoever_says_nothing_or_too_much_is_hung_up_on(target: str, said: bytes) -> None:
    with socket.socket(socket.AF_UNIX) as connection:
        connection.settimeout(60)
        connection.connect(memory_path(target))
        connection.sendall(said)
        with suppress(ConnectionResetError):  # what was not heard resets it
            while connection.recv(100):  # the region may have come before the rest was heard
                pass
    eventually(lambda: all_is_free(target))


@pytest.fixture(scope="module")
def shared(decoder: Decoder, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """A service at a Unix socket that shares up to four pairs of memory in three regions."""
    address = f"unix:{tmp_path_factory.mktemp('shared')}/s"
    service = begun(decoder, address=address)
    with SharedMemory(memory_path(address), 4 * PAIR, 3, silence_s=60) as memory:
        service.plane.shared = memory
        yield service
    service.end()


def asked(region: bytes, offset: int = 0) -> pb.DecodeFramesRequest:
    return pb.DecodeFramesRequest(header=header(shared=pb.SharedFrames(region=region, offset=offset)))


def fails(service: Running, *messages: pb.DecodeFramesRequest) -> Refused:
    return refused(lambda: service.stub.DecodeFrames(iter(messages), timeout=20))


def test_a_pair_in_shared_memory_is_decoded_as_one_that_is_sent(shared: Running) -> None:
    sent = shared.client.frames.decode(FRAMES, 16)
    with shared.client.frames.share_memory() as memory:
        assert memory.size == PAIR
        page = shared.client.frames.decode(FRAMES, 16, memory=memory)
        assert (
            shared.client.frames.decode(memory.frames(toy.SHAPE, "uint8"), 16, memory=memory).symbols == SYMBOLS
        ).all()
        inside = memory.frames(toy.SHAPE, "uint8")  # lies there the other way round: it is turned
        inside.in_phase[...], inside.quadrature[...] = FRAMES.quadrature, FRAMES.in_phase
        turned = shared.client.frames.decode(FramePair(inside.quadrature, inside.in_phase), 16, memory=memory)
    assert (turned.symbols == SYMBOLS).all()
    np.testing.assert_array_equal(page.confidence, sent.confidence)
    assert shared.plane.received.used == 0
    assert shared.client.describe().limits.shared_bytes == 4 * PAIR  # type: ignore[union-attr]


def test_pairs_may_lie_anywhere_in_their_region(shared: Running) -> None:
    other, second = a_page(seed=4)
    with shared.client.frames.share_memory(2 * PAIR + 7) as memory:
        for offset, pair in ((7, FRAMES), (7 + PAIR, second)):
            inside = memory.frames(toy.SHAPE, "uint8", offset)
            inside.in_phase[...], inside.quadrature[...] = pair.in_phase, pair.quadrature
        assert (shared.client.frames.decode(inside, 16, memory=memory).symbols == other).all()
        messages = [asked(memory.handle, 7), asked(memory.handle, PAIR + 8), asked(memory.handle, 7)]
        replies = list(shared.stub.DecodePages(iter(messages), timeout=20))
        assert [reply.decoded.symbols for reply in replies] == [SYMBOLS.tobytes(), b"", SYMBOLS.tobytes()]
        for offset in (PAIR + 8, (1 << 64) - 1):
            answer = fails(shared, asked(memory.handle, offset))
            assert (answer.code, answer.subject) == (grpc.StatusCode.INVALID_ARGUMENT, "header.shared.offset")


def test_unknown_foreign_and_dropped_regions_are_refused_alike(shared: Running) -> None:
    with shared.client.frames.share_memory() as memory:
        memory.write(FRAMES)
        handle = memory.handle
        answer = fails(shared, asked(handle), pb.DecodeFramesRequest(chunk=b"x"))  # pixels behind shared ones
        assert answer.reason == "FRAME_FORMAT"

    def is_gone() -> bool:
        with suppress(AssertionError):  # answered: the service has not seen yet that the client let go of it
            return fails(shared, asked(handle)).subject == "header.shared.region"
        return False

    eventually(is_gone)
    regions = (handle, handle[:-1], secrets.token_bytes(HANDLE_BYTES), b"", b"x" * 100_000)
    assert len({fails(shared, asked(region)).text for region in regions}) == 1


def test_a_call_that_is_cancelled_while_it_is_copied_gives_its_memory_back(
    shared: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    copying, go_on, add = threading.Event(), threading.Event(), PairReceiver.add

    def slow(receiver: PairReceiver, chunk: bytes | memoryview) -> None:
        copying.set()
        go_on.wait(60)
        add(receiver, chunk)

    monkeypatch.setattr(PairReceiver, "add", slow)
    with shared.client.frames.share_memory() as memory:
        memory.write(FRAMES)
        call = shared.stub.DecodeFrames.future(iter([asked(memory.handle)]), timeout=60)
        assert copying.wait(60)
        call.cancel()
        eventually(lambda: not shared.count("lightpage_calls_in_flight"))
        go_on.set()
        monkeypatch.undo()
        assert (shared.client.frames.decode(FRAMES, 16, memory=memory).symbols == SYMBOLS).all()
    eventually(lambda: shared.plane.received.used == 0)


def test_frames_that_do_not_fit_are_refused_before_they_are_written(shared: Running) -> None:
    with shared.client.frames.share_memory(PAIR - 1) as memory:
        with pytest.raises(InvalidInputError):
            shared.client.frames.decode(FRAMES, 16, memory=memory)
        with pytest.raises(FrameError):
            shared.client.frames.decode(replace(FRAMES, in_phase=FRAMES.in_phase[0]), 16, memory=memory)


def test_a_service_without_shared_memory_says_so(start: Start, service: Running, tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError):
        service.client.frames.share_memory()
    alone = start(address=f"unix:{tmp_path}/s")
    with pytest.raises(LightpageError):
        alone.client.frames.share_memory()
    assert fails(alone, asked(b"x")).subject == "header.shared"
