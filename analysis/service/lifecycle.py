"""A service's life from outside: its start, its answers whoever else asks, and its end.

    python -m analysis.service.lifecycle --json FILE

**Start**: from the command to the word that it serves, with the byte code at hand that every installation keeps; the
first start, which makes it, is told apart. **Stateless**: the same pair many times, another caller's
shifted pages between; all answers must be the same. **Stop**: SIGTERM beside an open health watch and calls in flight;
no call may be lost, and the end may take little longer than the longest decode.
"""

from __future__ import annotations

import hashlib
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import click
import grpc
import numpy as np
from grpc_health.v1 import health_pb2, health_pb2_grpc

from analysis.service.running import PagesToSend, RunningService, stub
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.metrics.provenance import write_figures
from lightpage.progress import track
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb

_SHIFTS_PX = (1, -2, 3, 0)
"""Shifts of another caller's pages, columns."""


def starts(count: int, own: tuple[str, ...]) -> dict[str, float]:
    """Start services, one after another, behind a first one that compiles all modules."""
    wall, cpu, memory = [], [], []
    with tempfile.TemporaryDirectory(prefix="lightpage-") as folder:
        # Whether byte code is kept must not depend on who measures.
        kept = {"PYTHONDONTWRITEBYTECODE": "", "PYTHONPYCACHEPREFIX": folder}
        for _ in track(range(1 + count), "starts", total=1 + count):
            with RunningService(*own, environment=kept) as service:
                wall.append(service.ready_s)
                cpu.append(service.ready_cpu_s)
                memory.append(service.resident_bytes() / 1e6)
    return {
        "starts": count,
        "wall_s": median(wall[1:]),
        "cpu_s": median(cpu[1:]),
        "first_cpu_s": cpu[0],
        "resident_mb": median(memory[1:]),
    }


def stateless(times: int, own: tuple[str, ...]) -> dict[str, int]:
    """Distinct answers to the same pair, in stateless mode and in a session of its own."""
    pages = PagesToSend()
    frames = (pages.pair.in_phase, pages.pair.quadrature)
    shifted = [FramePair(*(np.roll(frame, shift, axis=1) for frame in frames)) for shift in _SHIFTS_PX]
    found: dict[str, set[str]] = {"stateless": set(), "session": set()}
    asked = {
        "stateless": pages.requests(options=pb.DecodeOptions(tracking=pb.TRACKING_STATELESS)),
        "session": pages.requests(options=pb.DecodeOptions(session="mine")),
    }
    with RunningService(*own) as service, service.channel() as mine, service.channel() as other:
        for number in track(range(times), "the same pair", total=times):
            try:
                stub(other).DecodeFrames(iter(pages.requests(shifted[number % len(shifted)])), timeout=120)
            except grpc.RpcError as error:
                if error.code() not in (grpc.StatusCode.DATA_LOSS, grpc.StatusCode.INVALID_ARGUMENT):
                    raise
            for kind, requests in asked.items():
                reply = stub(mine).DecodeFrames(iter(requests), timeout=120)
                found[kind].add(hashlib.sha256(reply.symbols + reply.confidence).hexdigest())
    return {"times": times, **{f"distinct_{kind}": len(answers) for kind, answers in found.items()}}


def stops(count: int, own: tuple[str, ...]) -> dict[str, Any]:
    """End services that are at work."""
    pages = PagesToSend()
    requests = pages.requests()
    lost: list[str] = []
    beyond_s: list[float] = []
    for _ in track(range(count), "stops", total=count):
        with RunningService(*own) as service, service.channel() as channel, service.channel() as watching:
            watch: Iterator[Any] = health_pb2_grpc.HealthStub(watching).Watch(health_pb2.HealthCheckRequest())
            next(watch)
            decode_s = 0.0
            for _ in range(3):
                begun = time.monotonic()
                stub(channel).DecodeFrames(iter(requests), timeout=120)
                decode_s = time.monotonic() - begun
            ended: list[float] = []
            noted = partial(_note_end, ended)
            calls = [stub(channel).DecodeFrames.future(iter(requests), timeout=120) for _ in range(3)]
            for call in calls:
                call.add_done_callback(noted)
            threading.Event().wait(0.3 * decode_s)
            begun = time.monotonic()
            status = service.stop()
            gone = time.monotonic()
            for call in calls:
                try:
                    call.result()
                except grpc.RpcError as error:
                    lost.append(error.code().name)
            if status != 0:
                lost.append(f"exit status {status}")
            beyond_s.append(gone - max([begun, *ended]))
    return {"stops": count, "lost": lost, "beyond_last_answer_s": max(beyond_s)}


def _note_end(ended: list[float], _: object) -> None:
    ended.append(time.monotonic())


@click.command()
@click.option("--starts", "start_count", default=5, show_default=True, type=click.IntRange(1))
@click.option(
    "--times", default=100, show_default=True, type=click.IntRange(2), help="Times that the same pair is sent."
)
@click.option("--stops", "stop_count", default=10, show_default=True, type=click.IntRange(1))
@click.option("--threads", type=click.IntRange(1), help="Threads of an inference; by default all cores.")
@click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file.")
def main(start_count: int, times: int, stop_count: int, threads: int | None, json_path: Path | None) -> None:
    """Print how services start, answer and end."""
    own = () if threads is None else ("--threads", str(threads))
    start = starts(start_count, own)
    click.echo(
        f"start to ready: {start['cpu_s']:.2f} CPU s, {start['wall_s']:.2f} s of wall, {start['resident_mb']:.0f} MB; "
        f"the very first start {start['first_cpu_s']:.2f} CPU s"
    )
    same = stateless(times, own)
    click.echo(
        f"the same pair {times} times beside another caller's shifted pages: {same['distinct_stateless']} distinct "
        f"stateless, {same['distinct_session']} in a session"
    )
    stop = stops(stop_count, own)
    click.echo(
        f"{stop_count} stops beside an open watch and 3 calls in flight: {len(stop['lost'])} calls lost, ended at most "
        f"{stop['beyond_last_answer_s']:.2f} s after the last answer"
    )
    if json_path is not None:
        write_figures(json_path, {"start": start, "stateless": same, "stop": stop})


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.service.lifecycle"))
