"""Attacks on a service's shared memory: does it ever read outside a region, crash, or keep what it should let go of?

    python -m analysis.attacks.memory_attacks --json FILE

Each try is one of: a handle that was never given out, cut off, or of a region that is gone; an offset beyond the end; a
region that is dropped while a call reads it; a call that is cancelled; a region whose size its client tries to change;
garbage, too much, nothing, or a file descriptor at the socket where regions are given out. Between them, good pairs
must be answered. A try that is answered with a page though part of it lay outside its region counts as a read outside.
Once all callers have left, the service must hold no more regions and files than before, and no byte of its receive
budget. The exit status is 1 where any of this fails.
"""

from __future__ import annotations

import os
import random
import secrets
import socket
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import click

from analysis.service.constant_bundle import constant_bundle
from analysis.service.running import RunningService, until
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.device.profile import load_profile
from lightpage.errors import LightpageError
from lightpage.metrics.provenance import write_figures
from lightpage.progress import track
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2_grpc as pb_grpc
from lightpage.runtime.client.shared_memory import HANDLE_BYTES, SIZE, SharedMemory, memory_path
from lightpage.runtime.client.wire.channel import open_channel

CALL_S = 30.0
_CANCEL_S = 15e-3
"""Within so long after its begin a call is cancelled: some before its frames are copied, some meanwhile, some after."""
_SETTLE_S = 10.0
"""Until the service has let go of what callers left."""
_GOOD_EVERY = 500


class Attacker:
    """Makes tries.

    Args:
        target: address of the service.
        header: header of a good pair.
        pair: good pair.
        seed: seed of all choices.
    """

    def __init__(self, target: str, header: pb.DecodeHeader, pair: FramePair, seed: int) -> None:
        self._target, self._header, self._pair = target, header, pair
        self._size = 2 * pair.in_phase.nbytes
        self._chance = random.Random(seed)
        self._channel = open_channel(target)
        self._stub: Any = pb_grpc.LightpageStub(self._channel)  # type: ignore[no-untyped-call]
        self._memory = SharedMemory(target, self._size)
        self._memory.write(pair)
        self._gone: list[bytes] = [secrets.token_bytes(HANDLE_BYTES)]
        self.outside = 0
        """Pages that came of bytes outside a region."""

    def tries(self) -> dict[str, Callable[[], str]]:
        """The kinds of tries, each of which tells how one ended."""
        return {
            "made-up handle": lambda: self._bad(secrets.token_bytes(self._chance.choice([0, 1, 31, 32, 33, 5000])), 0),
            "handle cut off": lambda: self._bad(self._memory.handle[: self._chance.randrange(HANDLE_BYTES)], 0),
            "handle of a region that is gone": lambda: self._bad(self._chance.choice(self._gone), 0),
            "offset beyond the end": lambda: self._bad(self._memory.handle, self._beyond()),
            "larger frames than the region": lambda: self._bad(self._memory.handle, 0, self._size + 1),
            "dropped while it is read": self._dropped,
            "cancelled": self._cancelled,
            "size changed": self._resized,
            "garbage at the socket": self._garbage,
        }

    def good(self) -> bool:
        """Send a good pair, and return whether it is answered."""
        return self._ended(self._memory.handle, 0) == "OK"

    def close(self) -> None:
        """Close the connection and the region."""
        self._memory.close()
        self._channel.close()

    def _beyond(self) -> int:
        far = (1, 4095, 4096, self._size - 1, self._size, 1 << 31, 1 << 32, 1 << 62, (1 << 64) - 1)
        return self._chance.choice([*far, self._chance.randrange(1, 1 << 64)])

    def _begun(self, region: bytes, offset: int, rows_px: int | None = None) -> Any:
        """Begin a call."""
        header = pb.DecodeHeader()
        header.CopyFrom(self._header)
        header.shared.region, header.shared.offset = region, offset
        if rows_px is not None:
            header.rows_px = rows_px
        return self._stub.DecodeFrames.future(iter([pb.DecodeFramesRequest(header=header)]), timeout=CALL_S)

    def _ended(self, region: bytes, offset: int, rows_px: int | None = None) -> str:
        """Make a call, and return the name of its status code."""
        return str(self._begun(region, offset, rows_px).code().name)

    def _cancelled(self) -> str:
        """Cancel a call whose whole pair is there: a page may come of it, and its bytes of the receive budget come
        back.
        """
        call = self._begun(self._memory.handle, 0)
        time.sleep(self._chance.uniform(0, _CANCEL_S))
        call.cancel()
        return str(call.code().name)

    def _bad(self, region: bytes, offset: int, larger: int = 0) -> str:
        """Make a call of which no page may come, and count one that does."""
        ended = self._ended(region, offset, self._header.rows_px + 1 if larger else None)
        self.outside += ended == "OK"
        return ended

    def _dropped(self) -> str:
        """Drop a region during a call. The whole pair is there when it begins, so a page may come of it; a crash may
        not.
        """
        memory = SharedMemory(self._target, self._size)
        memory.write(self._pair)
        closing = threading.Timer(self._chance.uniform(0, 2e-3), memory.close)
        closing.start()
        try:
            return self._ended(memory.handle, 0)
        finally:
            closing.join()
            self._gone = [*self._gone[-20:], memory.handle]

    def _resized(self) -> str:
        """Ask for a region by hand, cut its descriptor, and have a call read where its end would have been."""
        with socket.socket(socket.AF_UNIX) as connection:
            connection.settimeout(CALL_S)
            connection.connect(memory_path(self._target))
            connection.sendall(SIZE.pack(self._size))
            answer, descriptors, _, _ = socket.recv_fds(connection, 1 + HANDLE_BYTES, 1)
            cut = False
            for descriptor in descriptors:
                os.pwrite(descriptor, self._pair.in_phase.tobytes() + self._pair.quadrature.tobytes(), 0)
                with suppress(OSError):
                    os.ftruncate(descriptor, self._chance.choice([0, 1, self._size // 2]))
                    cut = True
                os.close(descriptor)
            ended = self._ended(answer[1:], 0)
            self.outside += cut and ended == "OK"
            return "size was changed" if cut else ended

    def _garbage(self) -> str:
        said = self._chance.choice(
            [
                b"",
                self._chance.randbytes(self._chance.randrange(1, 8)),
                self._chance.randbytes(self._chance.randrange(9, 5000)),
                SIZE.pack(self._chance.choice([0, 1 << 40, (1 << 64) - 1])),
            ]
        )
        with socket.socket(socket.AF_UNIX) as connection:
            connection.settimeout(CALL_S)
            connection.connect(memory_path(self._target))
            with suppress(OSError):
                if self._chance.random() < 0.1:
                    socket.send_fds(connection, [said or b"x"], [0, 1, 2])
                else:
                    connection.sendall(said)
                if len(said) == SIZE.size and connection.recv(1) == b"\0":
                    self.outside += 1  # a region of an impossible size
        return "hung up"


def attacked(tries: int, seed: int) -> dict[str, Any]:
    """Attack a service and see how it fares."""
    with tempfile.TemporaryDirectory(prefix="lightpage-") as name:
        folder, profile = Path(name), load_profile("bench")
        pair = constant_bundle(folder / "constant.zip", profile)
        rows, columns = profile.frame_shape
        header = pb.DecodeHeader(rows_px=rows, columns_px=columns, pixel_type=pb.PIXEL_TYPE_UINT8, bit_depth=8)
        own = ("--bundle", str(folder / "constant.zip"), "--no-tracking", "--threads", "1")
        with RunningService(*own, "--address", f"unix:{folder}/socket", "--shared-memory") as service:
            assert service.process is not None  # it was started
            attacker = Attacker(service.target, header, pair, seed)
            kinds, ended, failed = attacker.tries(), Counter[str](), list[str]()
            before = _held(service.process.pid)
            names = list(kinds)
            for number in track(range(tries), "attacks", total=tries):
                kind = names[number % len(names)]
                try:
                    ended[f"{kind}: {kinds[kind]()}"] += 1
                except (OSError, LightpageError) as error:
                    failed.append(f"{kind}: {error}")
                if number % _GOOD_EVERY == 0 and not attacker.good():
                    failed.append(f"no answer to a good pair after {number} tries")
            good = attacker.good()
            attacker.close()
            alive = service.process.poll() is None
            after, receiving = _left(service, before) if alive else ((0, 0), 0)
            status = service.stop()
            log = service.log()
    return {
        "tries": tries,
        "ended": dict(sorted(ended.items())),
        "failed": failed,
        "reads_outside": attacker.outside,
        "good_at_the_end": good,
        "crashes": int(not alive) + int(status != 0),
        "regions_and_files_before": before,
        "regions_and_files_after": after,
        "receive_buffer_bytes_after": receiving,
        "tracebacks": log.count("Traceback"),
    }


def faults(found: Mapping[str, Any]) -> list[str]:
    """Return the faults in the figures of `attacked`, a few words each."""
    before, after = found["regions_and_files_before"], found["regions_and_files_after"]
    wrong = {
        f"{found['crashes']} crashes": found["crashes"],
        f"{found['reads_outside']} reads outside a region": found["reads_outside"],
        f"{found['tracebacks']} tracebacks": found["tracebacks"],
        f"{len(found['failed'])} tries failed otherwise": found["failed"],
        "no answer to a good pair at the end": not found["good_at_the_end"],
        f"{after[0]} regions mapped at the end, {before[0]} before": after[0] > before[0],
        f"{after[1]} files open at the end, {before[1]} before": after[1] > before[1],
        f"{found['receive_buffer_bytes_after']} bytes of the receive budget never given back": found[
            "receive_buffer_bytes_after"
        ],
    }
    return [words for words, is_so in wrong.items() if is_so]


def _left(service: RunningService, before: tuple[int, int]) -> tuple[tuple[int, int], int]:
    """Regions and files, and bytes of the receive budget, that a service holds once its callers have left."""
    held, receiving = (0, 0), 0
    for _ in until(time.monotonic() + _SETTLE_S, 0.2):
        held, receiving = _held(service.pid), int(service.metric("lightpage_receive_buffer_bytes"))
        if not receiving and all(now <= then for now, then in zip(held, before, strict=True)):
            break
    return held, receiving


def _held(process: int) -> tuple[int, int]:
    """Regions that are mapped by a process, and files that it has open."""
    maps = Path(f"/proc/{process}/maps").read_text()
    return maps.count("memfd:lightpage"), len(os.listdir(f"/proc/{process}/fd"))


@click.command()
@click.option(
    "--tries", default=20_000, show_default=True, type=click.IntRange(1), help="Tries of all kinds, in turns."
)
@click.option("--seed", default=0, show_default=True, type=click.IntRange(0))
@click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file.")
def main(tries: int, seed: int, json_path: Path | None) -> None:
    """Print how the tries ended."""
    found = attacked(tries, seed)
    for kind, count in found["ended"].items():
        click.echo(f"{count:>7}  {kind}")
    for each in found["failed"][:10]:
        click.echo(f"  {each}")
    click.echo(
        f"{tries} tries: {found['crashes']} crashes, {found['reads_outside']} reads outside a region, "
        f"{found['tracebacks']} tracebacks, {len(found['failed'])} failed otherwise"
    )
    (regions, files), (held, open_files) = found["regions_and_files_before"], found["regions_and_files_after"]
    click.echo(f"regions mapped: {regions} before, {held} after; open files: {files} before, {open_files} after")
    click.echo(f"receive budget: {found['receive_buffer_bytes_after']} bytes are held once all callers have left")
    wrong = faults(found)
    for words in wrong:
        click.echo(f"wrong: {words}")
    if json_path is not None:
        write_figures(json_path, found)
    if wrong:
        sys.exit(1)


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.attacks.memory_attacks"))
