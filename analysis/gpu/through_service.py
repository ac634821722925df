"""Measure how many pages a second callers get through a service that computes pages in batches.

    python -m analysis.gpu.through_service --bundle BUNDLE.zip --recording R.h5 --provider cuda --batches 16 --callers 8

Each caller shares memory with the service and has its own session. `python -m analysis.speed.provider` measures the
same without a service.
"""

from __future__ import annotations

import itertools
import json
import re
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import click

from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.files import write_json
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import narrow
from lightpage.recording.reader import Recording
from lightpage.runtime.client.client import LightpageClient
from lightpage.runtime.model.decoding.under_way import Device

_WARM_S = 3.0
"""Seconds before those that count: sizes of batches are met for the first time."""


@contextmanager
def served(arguments: Sequence[str]) -> Iterator[str]:
    """A service in a process of its own; yields the address of its metrics."""
    command = [sys.executable, "-m", "lightpage", "serve", "--metrics-port", "0", *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None  # asked for
            told = itertools.takewhile(lambda line: not line.startswith("serving"), process.stdout)
            yield next(found[1] for line in told if (found := re.search(r"metrics at (\S+),", line)))
        finally:
            process.terminate()


def metric(address: str, name: str) -> float:
    """A figure of a service, by its name and labels; 0 where it has none."""
    with urllib.request.urlopen(address, timeout=20) as answer:
        lines = answer.read().decode().splitlines()
    return sum(float(line.rpartition(" ")[2]) for line in lines if line.startswith(f"{name} "))


def called(target: str, name: str, pairs: list[FramePair], levels: int, seconds: float) -> int:
    """Have pages decoded in turn by one caller; returns how many were, behind the first few seconds."""
    count, begun = 0, time.monotonic() + _WARM_S
    with LightpageClient(target) as client, client.frames.share_memory() as memory:
        for pair in itertools.cycle(pairs):
            client.frames.decode(pair, levels, memory=memory, session=name)
            if (now := time.monotonic()) > begun + seconds:
                return count
            count += now > begun
    return count


@click.command()
@click.option("--bundle", required=True, type=click.Path(exists=True), help="Bundle with the decoder for many pages.")
@click.option("--recording", required=True, type=click.Path(exists=True), help="Pages that are sent in turn.")
@click.option("--provider", default="cuda", show_default=True)
@click.option("--batches", default=16, show_default=True, type=click.IntRange(1, 64), help="Computed together at most.")
@click.option("--callers", default=8, show_default=True, type=click.IntRange(1, 64))
@click.option("--pages", default=4, show_default=True, type=click.IntRange(1, 64), help="Pages of the recording.")
@click.option("--seconds", default=20.0, show_default=True, type=click.FloatRange(0.1, 600))
@click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file.")
def main(
    bundle: str,
    recording: str,
    provider: str,
    batches: int,
    callers: int,
    pages: int,
    seconds: float,
    json_path: Path | None,
) -> None:
    """Print pages a second, pages of a batch, and what the device did."""
    with Recording.open(recording) as file:
        pairs = [narrow(file.frames(page), file.bit_depth) for page in range(min(pages, file.pages))]
        levels = file.levels
    with tempfile.TemporaryDirectory() as folder:
        target = f"unix:{folder}/service"
        where = "--address", target, "--health-address", "off", "--shared-memory"
        arguments = "--bundle", bundle, "--provider", provider, "--batches", str(batches), *where
        with served(arguments) as metrics, ThreadPoolExecutor(callers) as pool:
            while not Path(f"{folder}/service").exists():
                time.sleep(0.1)
            names = [f"caller {number}" for number in range(callers)]
            begun = [pool.submit(called, target, name, pairs, levels, seconds) for name in names]
            rate = sum(each.result() for each in begun) / seconds
            runs, all_pages = (metric(metrics, f"lightpage_batch_pages_{what}") for what in ("count", "sum"))
            states = {state.value: f'lightpage_device_seconds_total{{state="{state}"}}' for state in Device}
            spent = {state: metric(metrics, name) for state, name in states.items()}
            mean = all_pages / runs if runs else 1.0
    told = {"pages_per_s": rate, "callers": callers, "batches": batches, "mean_batch": mean, "device_s": spent}
    click.echo(json.dumps(told, indent=1))
    if json_path is not None:
        write_json(json_path, told)


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.gpu.through_service"))
