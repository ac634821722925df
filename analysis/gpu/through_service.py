"""Measure how many pages a second callers get through a service that computes pages in batches.

    python -m analysis.gpu.through_service --bundle BUNDLE.zip --recording R.h5 --provider cuda --batches 16 --callers 8

First as many callers decode in this process. Then each shares memory with a service and has its own session. At last
one stream sends frames in chunks, to that service and to one that answers the same page whatever it is sent. What the
device did is of the seconds that count.
"""

from __future__ import annotations

import itertools
import json
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from analysis.gpu.callers import Pages, rate
from analysis.service.constant_bundle import constant_bundle
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.errors import LightpageError
from lightpage.metrics.provenance import write_figures
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import narrow
from lightpage.recording.reader import Recording
from lightpage.runtime.client.client import LightpageClient
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.decoding.batches import Batching
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.under_way import Device
from lightpage.runtime.model.execution.memory import share_freed_memory
from lightpage.runtime.model.execution.providers import Provider

Figures = dict[str, Any]
_STATES = {state.value: f'lightpage_device_seconds_total{{state="{state}"}}' for state in Device}
_RUNS, _PAGES = "lightpage_batch_pages_count", "lightpage_batch_pages_sum"


@contextmanager
def served(socket: Path, arguments: Sequence[str]) -> Iterator[str]:
    """A service in a process of its own, that listens at a socket; yields the address of its metrics."""
    where = "--address", f"unix:{socket}", "--health-address", "off", "--shared-memory"
    command = [sys.executable, "-m", "lightpage", "serve", "--metrics-port", "0", *where, *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None  # asked for
            told = itertools.takewhile(lambda line: not line.startswith("serving"), process.stdout)
            address = next(found[1] for line in told if (found := re.search(r"metrics at (\S+),", line)))
            while not socket.exists():
                time.sleep(0.1)
            yield address
        finally:
            process.terminate()


def in_process(decoder: Decoder, pairs: Sequence[FramePair], levels: int) -> Pages:
    """Decode here."""
    return lambda _: (decoder.decode(pair, levels) for pair in itertools.cycle(pairs))


def by_memory(target: str, pairs: Sequence[FramePair], levels: int) -> Pages:
    """Decode by a service that memory is shared with, each caller in a session of its own."""

    def pages(name: str) -> Iterator[object]:
        with LightpageClient(target) as client, client.frames.share_memory() as memory:
            for pair in itertools.cycle(pairs):
                yield client.frames.decode(pair, levels, memory=memory, session=name)

    return pages


def by_stream(target: str, pairs: Sequence[FramePair], levels: int) -> Pages:
    """Decode by a service that one stream of chunks is sent to."""

    def pages(name: str) -> Iterator[object]:
        with LightpageClient(target) as client:
            for page in client.frames.decode_many(itertools.cycle(pairs), levels, session=name):
                if isinstance(page, LightpageError):
                    raise page
                yield page

    return pages


def measured(
    bundle: Path,
    pairs: Sequence[FramePair],
    levels: int,
    provider: Provider,
    largest: int,
    callers: int,
    seconds: float,
) -> Figures:
    """Rates in this process, by shared memory and by streams, their ratios, and what the device did meanwhile.

    Args:
        bundle: bundle with the decoder for many pages.
        pairs, levels: pages that are decoded in turn.
        provider: provider that computes them.
        largest: pages of a batch at most.
        callers: callers at a time.
        seconds: seconds of each rate.
    """
    opened = Bundle.open(bundle)
    share_freed_memory()  # as a service does
    decoder = Decoder(opened, provider=provider, batching=Batching(largest))
    inside, _ = rate(in_process(decoder, pairs, levels), callers, seconds)
    del decoder  # its memory of the device is the service's now
    found: Figures = {"callers": callers, "batches": largest, "in_process_pages_per_s": inside}
    with tempfile.TemporaryDirectory() as folder:
        socket, constant = Path(folder, "service"), Path(folder, "constant.zip")
        target = f"unix:{socket}"
        with served(
            socket, ["--bundle", str(bundle), "--provider", str(provider), "--batches", str(largest)]
        ) as address:
            through, grown = rate(by_memory(target, pairs, levels), callers, seconds, address)
            stream, _ = rate(by_stream(target, pairs, levels), 1, seconds)
        sent = [constant_bundle(constant, opened.profile)]
        with served(socket, ["--bundle", str(constant), "--no-tracking"]):
            bare, _ = rate(by_stream(target, sent, 0), 1, seconds)
    runs = grown.get(_RUNS, 0.0)
    return found | {
        "pages_per_s": through,
        "over_in_process": through / inside,
        "mean_batch": grown[_PAGES] / runs if runs else 1.0,
        "device_s": {state: grown.get(name, 0.0) for state, name in _STATES.items()},
        "stream_pages_per_s": stream,
        "bare_stream_pages_per_s": bare,
        "stream_over_bare": stream / bare,
    }


@click.command()
@click.option("--bundle", required=True, type=click.Path(exists=True, path_type=Path), help="Bundle with batches.")
@click.option("--recording", required=True, type=click.Path(exists=True), help="Pages that are sent in turn.")
@click.option("--provider", default="cuda", show_default=True)
@click.option("--batches", default=16, show_default=True, type=click.IntRange(1, 64), help="Computed together at most.")
@click.option("--callers", default=8, show_default=True, type=click.IntRange(1, 64))
@click.option("--pages", default=4, show_default=True, type=click.IntRange(1, 64), help="Pages of the recording.")
@click.option(
    "--seconds", default=10.0, show_default=True, type=click.FloatRange(0.1, 600), help="Seconds of each rate."
)
@click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file.")
def main(
    bundle: Path,
    recording: str,
    provider: str,
    batches: int,
    callers: int,
    pages: int,
    seconds: float,
    json_path: Path | None,
) -> None:
    """Print pages a second, their ratios, pages of a batch, and what the device did."""
    with Recording.open(recording) as file:
        pairs = [narrow(file.frames(page), file.bit_depth) for page in range(min(pages, file.pages))]
        levels = file.levels
    told = measured(bundle, pairs, levels, Provider.parse(provider), batches, callers, seconds)
    click.echo(json.dumps(told, indent=1))
    if json_path is not None:
        write_figures(json_path, told)


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.gpu.through_service"))
