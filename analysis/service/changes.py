"""Model changes while pages are decoded: no answer may be wrong, mixed, or of a model that was not in service.

    python -m analysis.service.changes --changes 200 --json FILE

Three bundles of one device answer differently. Callers send the same pair all the time; the model in service is changed
at random by activation, roll-back and roll-forward. Every answer is compared with what its model alone makes of the
pair, and its model with those that were in service while the call lasted.
"""

from __future__ import annotations

import hashlib
import random
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import click
import grpc

from analysis.service.running import PagesToSend, RunningService, stub, until
from analysis.service.variants import answer_of, write_variant
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.errors import BundleError
from lightpage.metrics.provenance import write_figures
from lightpage.progress import track
from lightpage.runtime.client.client import LightpageClient
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.bundle.shipped import DEFAULT, bundle_path

_LEVELS = 256
_SHIFTS_PX = (0.2, -0.2)
_CALLERS = 2


@dataclass(frozen=True)
class _Answered:
    """A call: when it began and ended, and what came; an error's status in place of a version."""

    begun: float
    ended: float
    version: str
    symbols: str


@dataclass(frozen=True)
class _Changed:
    """A change: when it was asked for and answered, and the version in service from then on."""

    asked: float
    answered: float
    version: str


def call(service: RunningService, requests: list[Any], stop: threading.Event, answered: list[_Answered]) -> None:
    """Send the pair until told to stop."""
    with service.channel() as channel:
        while not stop.is_set():
            begun = time.monotonic()
            try:
                reply = stub(channel).DecodeFrames(iter(requests), timeout=120)
                found = reply.model_version, hashlib.sha256(reply.symbols).hexdigest()
            except grpc.RpcError as error:
                found = error.code().name, ""
            answered.append(_Answered(begun, time.monotonic(), *found))


def change(client: LightpageClient, versions: list[str], chance: random.Random) -> str | None:
    """Change the model at random; returns the version in service then, None where there was nothing to go to."""
    way = chance.randrange(4)
    try:
        if way == 0:
            return client.models.roll_back()[0]
        if way == 1:
            return client.models.roll_forward()[0]
        return client.models.activate(chance.choice(versions))[0]
    except BundleError:
        return None


def judged(answered: list[_Answered], changed: list[_Changed], expected: dict[str, str]) -> dict[str, int]:
    """Answers that should not be."""
    failed = wrong = stale = 0
    for one in answered:
        if one.version not in expected:
            failed += 1
            continue
        wrong += one.symbols != expected[one.version]
        before = [each.version for each in changed if each.answered <= one.begun][-1:]
        during = [each.version for each in changed if each.answered > one.begun and each.asked <= one.ended]
        stale += one.version not in (*before, *during)
    return {"answers": len(answered), "failed": failed, "wrong_or_mixed": wrong, "stale": stale}


@click.command()
@click.option("--changes", default=200, show_default=True, type=click.IntRange(1))
@click.option("--seed", default=0, show_default=True, type=click.IntRange(0))
@click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file.")
def main(changes: int, seed: int, json_path: Path | None) -> None:
    """Print failed, wrong and stale answers."""
    base, chance = Bundle.open(bundle_path(DEFAULT)), random.Random(seed)
    requests = PagesToSend().requests(options=pb.DecodeOptions(levels=_LEVELS))
    with tempfile.TemporaryDirectory(prefix="lightpage-") as folder:
        paths = [
            write_variant(base, f"variant-{number}", shift, Path(folder) / f"variant-{number}.zip")
            for number, shift in enumerate(_SHIFTS_PX)
        ]
        expected = {base.version: answer_of(bundle_path(DEFAULT), _LEVELS)}
        expected |= {Bundle.open(path).version: answer_of(path, _LEVELS) for path in paths}
        own = ("--store", f"{folder}/store", "--threads", "1", "--no-tracking")
        with RunningService(*own) as service, LightpageClient(service.target, 120) as client:
            for path in paths:
                client.models.upload(path)
            changed = [_Changed(0.0, 0.0, base.version)]
            answered: list[list[_Answered]] = [[] for _ in range(_CALLERS)]
            stop = threading.Event()
            threads = [threading.Thread(target=call, args=(service, requests, stop, each)) for each in answered]
            for thread in threads:
                thread.start()
            try:
                for _ in track(range(changes), "changes", total=changes):
                    version, asked = None, 0.0
                    for _ in until(time.monotonic() + 60):
                        asked = time.monotonic()
                        if (version := change(client, list(expected), chance)) is not None:
                            break
                    assert version is not None  # a model can always be activated
                    changed.append(_Changed(asked, time.monotonic(), version))
                    time.sleep(chance.random() * 0.3)
            finally:
                stop.set()
                for thread in threads:
                    thread.join()
    figures = judged(list(chain.from_iterable(answered)), changed, expected)
    figures |= {"changes": changes, "versions": len(expected), "distinct_answers": len(set(expected.values()))}
    click.echo(
        f"{changes} changes between {figures['versions']} models with {figures['distinct_answers']} different answers: "
        f"of {figures['answers']} answers {figures['failed']} failed, {figures['wrong_or_mixed']} wrong or mixed, "
        f"{figures['stale']} stale"
    )
    if json_path is not None:
        write_figures(json_path, figures)


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.service.changes"))
