"""Shared memory: frames in it are decoded as those that are sent, and nobody reads or shrinks what is not theirs."""

from __future__ import annotations

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
from runtime.client.client import LightpageClient
from runtime.client.shared_memory import SharedMemory as ClientMemory
from runtime.pb.lightpage.v1 import lightpage_pb2 as pb
from runtime.pb.lightpage.v1 import lightpage_pb2_grpc as pb_grpc
from runtime.rpc.server import LightpageServer
from runtime.service.receiver import PairReceiver
from runtime.service.shared_memory import Region, SharedMemory
from runtime.wire.channel import open_channel
from runtime.wire.shared_memory import HANDLE_BYTES, SIZE, memory_path
from tests.runtime import toy
from tests.runtime.rpc.stage import Running, Start, a_page, wait_until

PAIR = 2 * toy.SHAPE[0] * toy.SHAPE[1]


@pytest.fixture
def service(start: Start, tmp_path: Path) -> Iterator[Running]:
    """A service at a Unix socket that shares up to four pairs of memory in three regions."""
    running, address = start(), f"unix:{tmp_path}/s"
    with SharedMemory(memory_path(address), 4 * PAIR, 3, silence_s=0.5) as memory:
        running.plane.shared = memory
        with (
            LightpageServer(running.plane, running.recalibrator, address) as server,
            LightpageClient(address, timeout_s=20) as client,
        ):
            yield Running(running.plane, running.recalibrator, server, running.source, client)


def shared_of(service: Running) -> SharedMemory:
    assert service.plane.shared is not None
    return service.plane.shared


def header(region: bytes, offset: int = 0) -> pb.DecodeHeader:
    rows, columns = toy.SHAPE
    return pb.DecodeHeader(
        rows_px=rows,
        columns_px=columns,
        pixel_type=pb.PIXEL_TYPE_UINT8,
        bit_depth=8,
        options=pb.DecodeOptions(levels=16),
        shared=pb.SharedFrames(region=region, offset=offset),
    )


def decode(target: str, *requests: pb.DecodeFramesRequest) -> pb.DecodeReply:
    with open_channel(target) as channel:
        reply: pb.DecodeReply = pb_grpc.LightpageStub(channel).DecodeFrames(iter(requests), timeout=10)
        return reply


def test_a_pair_in_shared_memory_is_decoded_as_one_that_is_sent(service: Running) -> None:
    symbols, pair = a_page()
    sent = service.client.decode(pair, 16)
    with service.client.share_memory() as memory:
        assert memory.size == PAIR
        shared = service.client.decode(pair, 16, memory=memory)
        inside = memory.frames(toy.SHAPE, "uint8")
        again = service.client.decode(inside, 16, memory=memory)
    assert (shared.symbols == symbols).all()
    for page in (shared, again):
        np.testing.assert_array_equal(page.confidence, sent.confidence)
    assert service.plane.received.used == 0
    assert service.client.describe().limits.shared_bytes == 4 * PAIR


def test_a_pair_may_lie_anywhere_in_its_region(service: Running) -> None:
    symbols, pair = a_page()
    with service.client.share_memory(PAIR + 7) as memory:
        inside = memory.frames(toy.SHAPE, "uint8", 7)
        inside.in_phase[...], inside.quadrature[...] = pair.in_phase, pair.quadrature
        reply = decode(service.server.target, pb.DecodeFramesRequest(header=header(memory.handle, 7)))
        assert reply.symbols == symbols.tobytes()
        for offset in (8, PAIR, 1 << 40, (1 << 64) - 1):
            with pytest.raises(grpc.RpcError, match=r"header\.shared\.offset"):
                decode(service.server.target, pb.DecodeFramesRequest(header=header(memory.handle, offset)))


def test_a_pair_that_lies_there_the_other_way_round_is_turned(service: Running) -> None:
    symbols, pair = a_page()
    with service.client.share_memory() as memory:
        inside = memory.frames(toy.SHAPE, "uint8")
        inside.in_phase[...], inside.quadrature[...] = pair.quadrature, pair.in_phase
        page = service.client.decode(FramePair(inside.quadrature, inside.in_phase), 16, memory=memory)
        np.testing.assert_array_equal(inside.in_phase, pair.in_phase)
        np.testing.assert_array_equal(inside.quadrature, pair.quadrature)
    assert (page.symbols == symbols).all()


def test_many_pages_of_one_call_may_lie_there(service: Running) -> None:
    symbols, pair = a_page()
    with service.client.share_memory() as memory, open_channel(service.server.target) as channel:
        memory.write(pair)
        good = pb.DecodeFramesRequest(header=header(memory.handle))
        bad = pb.DecodeFramesRequest(header=header(memory.handle, 1))
        replies = list(pb_grpc.LightpageStub(channel).DecodePages(iter([good, bad, good]), timeout=20))
    outcomes = [reply.WhichOneof("outcome") for reply in replies]
    assert outcomes == ["decoded", "refused", "decoded"]
    assert replies[2].decoded.symbols == symbols.tobytes()


def test_unknown_foreign_and_dropped_regions_are_refused_alike(service: Running) -> None:
    _, pair = a_page()
    told = set()
    with service.client.share_memory() as memory:
        memory.write(pair)
        dropped, handle = memory.handle, memory.handle[:-1]
    assert wait_until(lambda: not shared_of(service).used_bytes)
    for region in (dropped, handle, secrets.token_bytes(HANDLE_BYTES), b"", b"x" * 100_000):
        with pytest.raises(grpc.RpcError) as caught:
            decode(service.server.target, pb.DecodeFramesRequest(header=header(region)))
        told.add((caught.value.code(), caught.value.details()))  # type: ignore[attr-defined]
    ((code, text),) = told
    assert code is grpc.StatusCode.INVALID_ARGUMENT
    assert "an unknown handle" in text


def test_pixels_that_follow_shared_ones_are_refused(service: Running) -> None:
    with service.client.share_memory() as memory:
        parts = pb.DecodeFramesRequest(header=header(memory.handle)), pb.DecodeFramesRequest(chunk=b"x")
        with pytest.raises(grpc.RpcError, match="as the header says"):
            decode(service.server.target, *parts)


def test_a_client_cannot_change_the_size_of_its_region(service: Running) -> None:
    with socket.socket(socket.AF_UNIX) as connection:
        connection.connect(memory_path(service.server.target))
        connection.sendall(SIZE.pack(PAIR))
        answer, (descriptor,), _, _ = socket.recv_fds(connection, 100, 1)
        try:
            for size in (0, PAIR - 1, PAIR + 1):
                with pytest.raises(PermissionError):
                    os.ftruncate(descriptor, size)
            with pytest.raises(PermissionError):
                fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, fcntl.F_SEAL_WRITE)
        finally:
            os.close(descriptor)
        assert len(answer) == 1 + HANDLE_BYTES


def test_a_region_that_is_dropped_while_it_is_read_stays_until_then() -> None:
    region = Region(1000)
    with region.reading(0, 1000) as view:
        region.drop()
        region.drop()
        assert bytes(view) == bytes(1000)
        with pytest.raises(InvalidInputError, match="an unknown handle"), region.reading(0, 1):
            pass
    assert region._memory.closed


def test_memory_is_bounded(service: Running) -> None:
    target = service.server.target
    for size in (4 * PAIR + 1, (1 << 63) - 1):
        with pytest.raises(LightpageError, match=f"{size} bytes, wanted 1 to {4 * PAIR}"):
            ClientMemory(target, size)
    with ClientMemory(target, 3 * PAIR), pytest.raises(LightpageError, match="try again later"):
        ClientMemory(target, 2 * PAIR)
    assert wait_until(lambda: not shared_of(service).used_bytes)
    regions = [ClientMemory(target, 1) for _ in range(3)]
    with pytest.raises(LightpageError, match="at most 3"):
        ClientMemory(target, 1)
    for region in regions:
        region.close()
    assert wait_until(lambda: not shared_of(service).used_bytes)


@pytest.mark.parametrize("said", [b"", b"\x01\x02", SIZE.pack(PAIR) + b"more"])
def test_whoever_says_nothing_or_too_much_is_hung_up_on(service: Running, said: bytes) -> None:
    with socket.socket(socket.AF_UNIX) as connection:
        connection.settimeout(10)
        connection.connect(memory_path(service.server.target))
        connection.sendall(said)
        with suppress(ConnectionResetError):  # what was not heard resets it
            while connection.recv(100):  # the region may have come before the rest was heard
                pass
    assert wait_until(lambda: not shared_of(service).used_bytes)


def test_contents_that_change_while_they_are_decoded_harm_nobody(service: Running) -> None:
    _, pair = a_page()
    stop = threading.Event()
    with service.client.share_memory() as memory:
        inside = memory.frames(toy.SHAPE, "uint8")
        memory.write(pair)

        def scribble() -> None:
            rng = np.random.default_rng(0)
            while not stop.is_set():
                inside.quadrature[...] = rng.integers(0, 256, toy.SHAPE, np.uint8)

        thread = threading.Thread(target=scribble)
        thread.start()
        try:
            for _ in range(20):
                try:
                    service.client.decode(inside, 16, memory=memory)
                except LightpageError:
                    continue  # what it saw was no page
        finally:
            stop.set()
            thread.join()
        memory.write(pair)
        assert service.client.decode(pair, 16, memory=memory).model_version == "toy-1"


def test_a_call_that_is_cancelled_while_it_is_copied_gives_its_memory_back(
    service: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    copying, go_on = threading.Event(), threading.Event()
    add = PairReceiver.add

    def slow(receiver: PairReceiver, chunk: bytes | memoryview) -> None:
        copying.set()
        go_on.wait(10)
        add(receiver, chunk)

    monkeypatch.setattr(PairReceiver, "add", slow)
    with service.client.share_memory() as memory, open_channel(service.server.target) as channel:
        memory.write(a_page()[1])
        request = pb.DecodeFramesRequest(header=header(memory.handle))
        call = pb_grpc.LightpageStub(channel).DecodeFrames.future(iter([request]), timeout=10)
        assert copying.wait(10)
        call.cancel()
        assert wait_until(lambda: not service.count("lightpage_calls_in_flight"))
        go_on.set()
        monkeypatch.undo()
        assert service.client.decode(a_page()[1], 16, memory=memory).model_version == "toy-1"
    assert service.plane.received.used == 0


def test_two_pairs_of_one_region_are_told_apart(service: Running) -> None:
    (first, one), (second, two) = a_page(seed=3), a_page(seed=4)
    with service.client.share_memory(2 * PAIR) as memory:
        inside = [memory.frames(toy.SHAPE, "uint8", offset) for offset in (0, PAIR)]
        for frames, pair in zip(inside, (one, two), strict=True):
            frames.in_phase[...], frames.quadrature[...] = pair.in_phase, pair.quadrature
        assert (service.client.decode(inside[1], 16, memory=memory).symbols == second).all()
        assert (service.client.decode(inside[0], 16, memory=memory).symbols == first).all()


@pytest.mark.parametrize("size", [-1, 1 << 63, 1 << 64])
def test_an_impossible_size_is_named(service: Running, size: int) -> None:
    with pytest.raises(InvalidInputError, match="size of shared memory"):
        ClientMemory(service.server.target, size)


def test_what_lies_where_the_socket_would_be_stays(tmp_path: Path) -> None:
    path = tmp_path / "s.memory"
    path.write_text("mine")
    with pytest.raises(InvalidInputError, match="something that is no socket"), SharedMemory(str(path), 1, 1, 1.0):
        pass
    assert path.read_text() == "mine"


def test_a_service_without_shared_memory_says_so(start: Start, tmp_path: Path) -> None:
    running, address = start(), f"unix:{tmp_path}/s"
    assert running.client.describe().limits.shared_bytes == 0
    with pytest.raises(InvalidInputError, match="unix:PATH"):
        running.client.share_memory()
    with LightpageServer(running.plane, running.recalibrator, address), LightpageClient(address) as client:
        with pytest.raises(LightpageError, match=r"--shared-memory"):
            client.share_memory()
        with pytest.raises(grpc.RpcError, match="shares no memory"):
            decode(address, pb.DecodeFramesRequest(header=header(b"x")))


def test_frames_that_do_not_fit_are_refused_before_they_are_written(service: Running) -> None:
    _, pair = a_page()
    with service.client.share_memory(PAIR - 1) as memory:
        with pytest.raises(InvalidInputError, match="within"):
            service.client.decode(pair, 16, memory=memory)
        with pytest.raises(FrameError):
            service.client.decode(replace(pair, in_phase=pair.in_phase[0]), 16, memory=memory)
