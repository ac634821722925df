"""A long run at most of the service's load: its memory must not grow.

    python -m analysis.service.soak --minutes 30 --json FILE

Pairs are sent at 80% of what the service decodes, over connections that come and go; now and then a page of its source,
a bad message and a stream that is left. Memory is looked at every few seconds. Growth is that of its median, from the
first tenth behind the warm-up to the last tenth. The warm-up is as long as the service keeps the answers of request
ids, ten minutes: until then its memory is meant to grow.
"""

from __future__ import annotations

import random
import sys
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path
from statistics import median

import click
import grpc

from analysis.service.overload import capacity
from analysis.service.running import PagesToSend, RunningService, stub, until
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.metrics.provenance import write_figures
from lightpage.progress import track
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.service.server.dispatcher import SERVICE

_LOOK_S = 2.0
_CALLERS = 4


def call(service: RunningService, rate: float, end: float, seed: int, ended: Counter[str]) -> None:
    """Send pairs at a rate until the end, and now and then something else."""
    requests, chance = PagesToSend().requests(), random.Random(seed)
    for _ in until(end, 20 / rate):
        with service.channel() as channel:
            for _ in until(min(end, time.monotonic() + 20 / rate), 1 / rate):
                try:
                    kind = chance.random()
                    if kind < 0.05:
                        channel.unary_unary(f"/{SERVICE.full_name}/ReadPage", None, None)(b"\xff", timeout=60)
                    elif kind < 0.1:
                        stub(channel).DecodeFrames(iter(requests[:2]), timeout=60)
                    elif kind < 0.2:
                        stub(channel).ReadPage(pb.ReadPageRequest(request_id=str(chance.random())), timeout=60)
                    else:
                        stub(channel).DecodeFrames(iter(requests), timeout=60)
                    ended["OK"] += 1
                except grpc.RpcError as error:
                    ended[error.code().name] += 1


@click.command()
@click.option("--minutes", default=30.0, show_default=True, type=click.FloatRange(0.1))
@click.option("--warm-up", default=10.0, show_default=True, type=click.FloatRange(0.0), help="Minutes before these.")
@click.option("--load", default=0.8, show_default=True, type=click.FloatRange(0.05, 1.0), help="Share of capacity.")
@click.option("--threads", type=click.IntRange(1), help="Threads of an inference; by default all cores.")
@click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file.")
def main(minutes: float, warm_up: float, load: float, threads: int | None, json_path: Path | None) -> None:
    """Print how the service's memory grew."""
    own = () if threads is None else ("--threads", str(threads))
    with tempfile.TemporaryDirectory(prefix="lightpage-") as folder:
        source = PagesToSend().record(Path(folder) / "pages.h5")
        with RunningService("--source", f"recording:{source}", *own) as service:
            alone = capacity(service, PagesToSend(), 10.0)
            end, ended = time.monotonic() + 60 * (warm_up + minutes), Counter[str]()
            rate = load * alone / _CALLERS
            callers = [
                threading.Thread(target=call, args=(service, rate, end, seed, ended)) for seed in range(_CALLERS)
            ]
            for each in callers:
                each.start()
            resident: list[int] = []
            looks = int(60 * (warm_up + minutes) / _LOOK_S)
            for _ in track(range(looks), "soak", total=looks):
                time.sleep(_LOOK_S)
                resident.append(service.resident_bytes())
            for each in callers:
                each.join()
            status = service.stop()
    warm = resident[int(60 * warm_up / _LOOK_S) :]
    tenth = max(1, len(warm) // 10)
    first, last = median(warm[:tenth]), median(warm[-tenth:])
    figures = {
        "minutes": minutes,
        "warm_up_minutes": warm_up,
        "calls": sum(ended.values()),
        "ended": dict(ended),
        "first_mb": first / 1e6,
        "last_mb": last / 1e6,
        "growth": last / first - 1,
        "exit_status": status,
        "resident_mb": [each / 1e6 for each in resident],
    }
    click.echo(
        f"{minutes:g} minutes at {load:.0%} behind a warm-up of {warm_up:g}: {figures['calls']} calls ({dict(ended)}), "
        f"memory from {first / 1e6:.1f} to {last / 1e6:.1f} MB, {figures['growth']:+.2%}"
    )
    if json_path is not None:
        write_figures(json_path, figures)


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.service.soak"))
