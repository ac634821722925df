"""Times a call beside its decode: frames in chunks, in shared memory, and a bare stream of the same bytes.

    python -m analysis.service.transport --json FILE

The three take turns, pair after pair, so that all of them see the same machine. The service's bundle answers the same
page whatever it sees; the time of each decode, which the service tells, is taken off.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import click
import grpc
import numpy as np

from analysis.service.bare_stream import PATH
from analysis.service.constant_bundle import constant_bundle
from analysis.service.running import RunningService
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.device.profile import load_profile
from lightpage.metrics.provenance import write_figures
from lightpage.progress import track
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.client.answers import RemotePage
from lightpage.runtime.client.client import LightpageClient
from lightpage.runtime.client.wire.messages import CHUNK_BYTES

CALL_S = 60.0
_WARM = 5
"""Calls of each that are not counted: buffers and connections are made in them."""


@contextmanager
def bare_server() -> Iterator[str]:
    """A server that takes bytes, in a process of its own; yields its address."""
    command = [sys.executable, "-m", "analysis.service.bare_stream"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None  # asked for
        assert process.stdin is not None
        try:
            yield f"127.0.0.1:{int(process.stdout.readline())}"
        finally:
            process.stdin.close()
            process.wait(CALL_S)


def bare_call(channel: grpc.Channel, pair: FramePair) -> Callable[[], None]:
    """Sends a pair's bytes in chunks, as they are."""
    call = channel.stream_unary(PATH, None, None)
    data = b"".join(frame.tobytes() for frame in (pair.in_phase, pair.quadrature))

    def send() -> None:
        chunks = (data[start : start + CHUNK_BYTES] for start in range(0, len(data), CHUNK_BYTES))
        if int(call(chunks, timeout=CALL_S)) != len(data):
            raise RuntimeError("a bare stream lost bytes")

    return send


def timed(calls: dict[str, Callable[[], RemotePage | None]], repeats: int) -> dict[str, list[float]]:
    """Seconds of each call beside its decode, in turns."""
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for number in track(range(_WARM + repeats), "calls", total=_WARM + repeats):
        for name, call in calls.items():
            begun = time.perf_counter()
            page = call()
            took = time.perf_counter() - begun - (page.timings.decode_s if page is not None else 0.0)
            if number >= _WARM:
                seconds[name].append(took)
    return seconds


def measured(profile_name: str, repeats: int) -> dict[str, Any]:
    """Median and spread of each way, milliseconds, and what the chunks take over the bare stream."""
    with tempfile.TemporaryDirectory(prefix="lightpage-") as name, ExitStack() as stack:
        folder, profile = Path(name), load_profile(profile_name)
        pair = constant_bundle(folder / "constant.zip", profile)
        own = ("--bundle", str(folder / "constant.zip"), "--no-tracking")
        service = stack.enter_context(RunningService(*own))
        at_socket = ("--address", f"unix:{folder}/socket", "--shared-memory")
        local = stack.enter_context(RunningService(*own, *at_socket))
        client = stack.enter_context(LightpageClient(service.target, CALL_S))
        near = stack.enter_context(LightpageClient(local.target, CALL_S))
        memory = stack.enter_context(near.frames.share_memory())
        inside = memory.frames(profile.frame_shape, "uint8")
        memory.write(pair)
        channel = stack.enter_context(grpc.insecure_channel(stack.enter_context(bare_server())))
        bare = bare_call(channel, pair)
        seconds = timed(
            {
                "bare stream": bare,
                "chunks": lambda: client.frames.decode(pair),
                "shared memory, copied into it": lambda: near.frames.decode(pair, memory=memory),
                "shared memory, in it already": lambda: near.frames.decode(inside, memory=memory),
            },
            repeats,
        )
    ways = {
        name: dict(zip(("p10_ms", "p50_ms", "p90_ms"), 1e3 * np.quantile(taken, [0.1, 0.5, 0.9]), strict=True))
        for name, taken in seconds.items()
    }
    ratios = np.array(seconds["chunks"]) / np.array(seconds["bare stream"])
    turns = dict(zip(("p10", "p50", "p90"), np.quantile(ratios, [0.1, 0.5, 0.9]), strict=True))
    return {
        "pair_bytes": 2 * pair.in_phase.nbytes,
        "repeats": repeats,
        "ways": ways,
        "chunks_over_bare": ways["chunks"]["p50_ms"] / ways["bare stream"]["p50_ms"],
        "chunks_over_bare_in_turns": turns,
    }


@click.command()
@click.option("--profile", "profile_name", default="paper", show_default=True, help="Device whose frames are sent.")
@click.option("--repeats", default=40, show_default=True, type=click.IntRange(3), help="Calls of each way.")
@click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file.")
def main(profile_name: str, repeats: int, json_path: Path | None) -> None:
    """Print what calls take beside the decode."""
    found = measured(profile_name, repeats)
    click.echo(
        f"a pair of {found['pair_bytes'] / 1e6:.1f} MB, {repeats} calls of each, call minus decode, milliseconds"
    )
    click.echo(f"{'':<32}{'p10':>8}{'p50':>8}{'p90':>8}")
    for name, row in found["ways"].items():
        click.echo(f"{name:<32}{row['p10_ms']:>8.1f}{row['p50_ms']:>8.1f}{row['p90_ms']:>8.1f}")
    turns = found["chunks_over_bare_in_turns"]
    click.echo(
        f"chunks over the bare stream: {found['chunks_over_bare']:.2f} of the medians, {turns['p50']:.2f} in turns "
        f"({turns['p10']:.2f} to {turns['p90']:.2f})"
    )
    if json_path is not None:
        write_figures(json_path, found)


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.service.transport"))
