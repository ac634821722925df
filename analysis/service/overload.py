"""Ten times more pages than the service can decode: how many are answered in time, and what is wasted.

    python -m analysis.service.overload --json FILE

Callers send pairs with a deadline of so many seconds, ten times as often as the service decodes. **Goodput** is the
rate of answers in time over the rate at which two callers without a deadline are answered, just before and just after:
machines change their speed. The median of some rounds is told. A decode is wasted if nobody got its answer. Health
checks, and an idle probe process that answers the same checks beside the same load, are asked meanwhile. All pairs are
of one session, as those of a device are: a session's first page takes longer.
"""

from __future__ import annotations

import sys
import threading
import time
from collections import Counter
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path
from statistics import fmean, median
from typing import Any

import click
import grpc
from grpc_health.v1 import health_pb2, health_pb2_grpc

from analysis.service.running import PagesToSend, RunningService, quantiles_ms, stub, until
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.metrics.provenance import write_figures
from lightpage.progress import track
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.service.server.health_server import HealthServer

_CONNECTIONS = 24
_ONE_DEVICE = pb.DecodeOptions(session="device")


class Checks:
    """Asks for health every 20 ms, of two servers in turn, and notes how long each answer took."""

    def __init__(self, **targets: str) -> None:
        self._stop, self._targets = threading.Event(), targets
        self.seconds: dict[str, list[float]] = {name: [] for name in targets}
        self.failed: Counter[str] = Counter()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> Checks:
        self._stop.clear()
        self._thread = threading.Thread(target=self._run, name="checks")
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        assert self._thread is not None  # it was entered
        self._stop.set()
        self._thread.join()

    def figures(self) -> dict[str, Any]:
        """Return the quantiles of each server's checks, milliseconds, and how many failed."""
        return {name: {**quantiles_ms(found), "failed": self.failed[name]} for name, found in self.seconds.items()}

    def _run(self) -> None:
        with ExitStack() as stack:
            stubs = {
                name: health_pb2_grpc.HealthStub(stack.enter_context(grpc.insecure_channel(target)))
                for name, target in self._targets.items()
            }
            while not self._stop.wait(0.02):
                for name, asked in stubs.items():
                    begun = time.perf_counter()
                    try:
                        answer = asked.Check(health_pb2.HealthCheckRequest(), timeout=5)
                        self.failed[name] += answer.status != health_pb2.HealthCheckResponse.SERVING
                    except grpc.RpcError:
                        self.failed[name] += 1
                    self.seconds[name].append(time.perf_counter() - begun)


def capacity(service: RunningService, pages: PagesToSend, seconds: float) -> float:
    """Pages a second of two callers that wait for each answer."""
    done, end = [0, 0], time.monotonic() + seconds
    requests = pages.requests(options=_ONE_DEVICE)

    def call(which: int) -> None:
        with service.channel() as channel:
            for _ in until(end):
                stub(channel).DecodeFrames(iter(requests), timeout=120)
                done[which] += 1

    begun = time.monotonic()
    threads = [threading.Thread(target=call, args=(which,)) for which in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return sum(done) / (time.monotonic() - begun)


def overload(
    service: RunningService, pages: PagesToSend, rate: float, deadline_s: float, seconds: float
) -> dict[str, Any]:
    """Send `rate` pairs a second, whatever becomes of them."""
    requests, ended = pages.requests(options=_ONE_DEVICE), Counter[str]()
    before = service.metric("lightpage_pages_total")
    begun = time.monotonic()
    with ExitStack() as stack:
        methods = [stub(stack.enter_context(service.channel())).DecodeFrames for _ in range(_CONNECTIONS)]
        pending: list[Any] = []
        last = [begun]

        def answered(call: Any) -> None:
            if call.code() is grpc.StatusCode.OK:
                last.append(time.monotonic())

        for number, _ in enumerate(until(begun + seconds, 1 / rate)):
            pending.append(methods[number % _CONNECTIONS].future(iter(requests), timeout=deadline_s))
            pending[-1].add_done_callback(answered)
        for call in pending:
            try:
                call.result()
                ended["OK"] += 1
            except grpc.RpcError as error:
                ended[error.code().name] += 1
        took = max(last) - begun
    time.sleep(2.0)  # decodes that nobody waits for any more
    decoded = service.metric("lightpage_pages_total") - before
    return {
        "asked": len(pending),
        "asked_per_s": len(pending) / seconds,
        "answered": ended["OK"],
        "answered_per_s": ended["OK"] / took if took else 0.0,
        "ended": dict(ended),
        "decodes": decoded,
    }


def stalled(service: RunningService, pages: PagesToSend, streams: int, seconds: float) -> dict[str, Any]:
    """Streams that send a header and one chunk and then nothing, and one caller who wants to be served beside them."""
    over, answered, refused = threading.Event(), 0, 0
    requests = pages.requests(options=_ONE_DEVICE)

    def stalling() -> Any:
        yield requests[0]
        yield requests[1]
        over.wait(seconds + 60)

    with ExitStack() as stack:
        end = time.monotonic() + seconds
        methods = [stub(stack.enter_context(service.channel())).DecodeFrames for _ in range(8)]
        mine = stub(stack.enter_context(service.channel())).DecodeFrames
        calls: list[Any] = []
        for _ in until(end):
            calls = [call for call in calls if not call.done()]
            calls += [methods[number % 8].future(stalling(), timeout=120) for number in range(streams - len(calls))]
            try:
                mine(iter(requests), timeout=20)
                answered += 1
            except grpc.RpcError:
                refused += 1
        over.set()
        for call in calls:
            call.cancel()
    return {"streams": streams, "answered_beside": answered, "not_answered_beside": refused}


@click.command()
@click.option("--times", default=10.0, show_default=True, help="Load over capacity.")
@click.option("--deadline", "deadline_s", default=2.0, show_default=True, help="Deadline of every call, seconds.")
@click.option("--rounds", default=3, show_default=True, type=click.IntRange(1), help="Rounds of capacity and overload.")
@click.option("--seconds", default=20.0, show_default=True, help="Seconds of each part.")
@click.option("--threads", type=click.IntRange(1), help="Threads of an inference; by default all cores.")
@click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file.")
def main(
    times: float, deadline_s: float, rounds: int, seconds: float, threads: int | None, json_path: Path | None
) -> None:
    """Print goodput, wasted decodes, and health checks under overload and under stalled streams."""
    pages = PagesToSend()
    own = () if threads is None else ("--threads", str(threads))
    with RunningService(*own) as service, HealthServer("127.0.0.1:0", lambda: {"": True}) as idle:
        with service.channel() as channel:
            for _ in range(3):
                stub(channel).DecodeFrames(iter(pages.requests(options=_ONE_DEVICE)), timeout=120)
            stub(channel).Describe(pb.DescribeRequest(), timeout=10)
        targets = {"health_port": service.health, "service_port": service.target, "idle_probe": idle.target}
        loaded: list[dict[str, Any]] = []
        with Checks(**targets):  # they cost time too
            alone = [capacity(service, pages, seconds / 2)]
        checks = Checks(**targets)
        for _ in track(range(rounds), "overload", unit="round"):
            with checks:
                loaded.append(overload(service, pages, times * alone[-1], deadline_s, seconds))
            with Checks(**targets):
                alone.append(capacity(service, pages, seconds / 2))
        under_load = checks.figures()
        with Checks(**targets) as checks:
            beside = stalled(service, pages, 60, seconds / 2)
        under_stalls = checks.figures()
        resident = service.resident_bytes()
    goodput = [one["answered_per_s"] / fmean(sides) for one, sides in zip(loaded, pairwise(alone), strict=True)]
    ended = sum((Counter(one["ended"]) for one in loaded), Counter[str]())
    decodes = sum(one["decodes"] for one in loaded)
    figures = {
        "capacity_per_s": alone,
        "overload": loaded,
        "goodput": median(goodput),
        "goodput_of_rounds": goodput,
        "wasted_share": (decodes - ended["OK"]) / max(1.0, decodes),
        "health_under_overload": under_load,
        "stalled": beside,
        "health_under_stalls": under_stalls,
        "resident_mb": resident / 1e6,
    }
    asked = fmean(one["asked_per_s"] for one in loaded)
    click.echo(f"capacity: {fmean(alone):.2f} pages/s; asked {asked:.1f}/s with {deadline_s:g} s to answer")
    shown = ", ".join(f"{one:.2f}" for one in goodput)
    click.echo(
        f"goodput {median(goodput):.2f} of it ({shown}); {dict(ended)}; wasted decodes {figures['wasted_share']:.1%}"
    )
    click.echo(
        f"60 stalled streams: {beside['answered_beside']} pages answered beside, {beside['not_answered_beside']} not"
    )
    for name, found in (("overload", under_load), ("stalled streams", under_stalls)):
        for server, one in found.items():
            click.echo(
                f"health under {name}, {server}: {one['count'] - one['failed']:.0f} of {one['count']:.0f} answered, "
                f"p50 {one['p50_ms']:.1f}, p99 {one['p99_ms']:.1f}, max {one['max_ms']:.1f} ms"
            )
    if json_path is not None:
        write_figures(json_path, figures)


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.service.overload"))
