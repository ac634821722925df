"""A service under load: as calibrated, after a drift, recalibrated and overloaded."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import click
import grpc
import numpy as np

from analysis.service.overload import capacity
from analysis.service.running import PagesToSend, RunningService, stub
from lightpage.demo.drift import drifted
from lightpage.demo.pages import SPOILT_PAGE, write_pages
from lightpage.demo.picture import picture
from lightpage.device.state import Device
from lightpage.errors import LightpageError
from lightpage.progress import track
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.pages import Pages
from lightpage.runtime.client.client import LightpageClient
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.device.acquisition.simulator import SimulatorSource
from lightpage.runtime.device.acquisition.source import SHOT_S, Shot
from lightpage.runtime.model.decoding.decoder import Decoder

_PAGES = tuple(page for page in range(6) if page != SPOILT_PAGE)
_DRIFT = 0.1
"""Share of the change of temperature of `drifted`: margin is lost, and no page yet."""
_DEADLINE_S = 4.0
_CALLERS = 32
SESSION = "device"
"""Session of all callers; the service has to be told that its frames are of its device."""
_USER_BYTES = pb.DecodeOptions(want_user_data=True, session=SESSION)


@dataclass(frozen=True)
class Shots:
    """Pages of a simulated device, and its reference beam."""

    pages: tuple[Shot, ...]
    references: FramePair


def shots(decoder: Decoder, folder: Path) -> tuple[Shots, Shots]:
    """Pages of user bytes on the bench device, as it was calibrated and after a drift."""
    write_pages(decoder, picture(), folder / "pages.h5", 0)
    source = SimulatorSource(decoder.bundle.profile, Device(), written=Pages.open(folder / "pages.h5"))
    taken = []
    with source:
        for device in (Device(), drifted(Device(), _DRIFT)):
            source.set_device(device)
            pages = [source.shot(SHOT_S, n) for n in track(_PAGES, "simulate", total=len(_PAGES))]
            taken.append(Shots(tuple(pages), source.references()))
    return taken[0], taken[1]


class Load:
    """Callers that send pairs of the device, now and then two in one call.

    Args:
        service: service that they call.
        rate: calls a second, of all callers together.
    """

    def __init__(self, service: RunningService, rate: float) -> None:
        self._service, self._rate, self.factor = service, rate, 1.0
        self.pairs: Sequence[FramePair] = ()
        self._stop = threading.Event()
        self._threads = [threading.Thread(target=self._call, args=(number,)) for number in range(_CALLERS)]

    def __enter__(self) -> Load:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join()

    def _call(self, number: int) -> None:
        chance, sent = np.random.default_rng(number), PagesToSend()
        with self._service.channel() as channel:
            while not self._stop.wait(chance.exponential(_CALLERS / (self.factor * self._rate))):
                pair = self.pairs[int(chance.integers(len(self.pairs)))]
                with suppress(grpc.RpcError):
                    requests = sent.requests(pair, options=_USER_BYTES)
                    if chance.random() < 0.1:
                        list(stub(channel).DecodePages(iter(2 * requests), timeout=2 * _DEADLINE_S))
                    else:
                        stub(channel).DecodeFrames(iter(requests), timeout=_DEADLINE_S)


def scenario(service: RunningService, decoder: Decoder, seconds: float, folder: Path) -> None:
    """Use the service as calibrated, drifted, recalibrated and overloaded, each for a while."""
    click.echo("simulate pages")
    fresh, moved = shots(decoder, folder)
    pairs = [[shot.pair for shot in taken.pages] for taken in (fresh, moved)]
    known = [(shot.pair, shot.symbols) for shot in moved.pages[1:4] if shot.symbols is not None]
    rate = capacity(service, PagesToSend(), 8.0)
    click.echo(f"the service decodes {rate:.2f} pages a second")
    load = Load(service, rate)

    def phase(what: str, of: Sequence[FramePair], factor: float) -> None:
        click.echo(what)
        load.pairs, load.factor = of, factor
        time.sleep(seconds)

    load.pairs = pairs[0]
    with load, LightpageClient(service.target, timeout_s=120) as client:
        phase("as calibrated", pairs[0], 0.5)
        phase("after a drift", pairs[1], 0.5)
        click.echo("recalibrate")
        started = client.jobs.start_with_frames(
            [pair for pair, _ in known],
            [symbols for _, symbols in known],
            moved.references,
            levels=decoder.page_codec.code.levels,
        )
        try:
            last = started
            for job in client.jobs.watch(started.id):
                last = job
            click.echo(f"recalibration: {last.state}")
        except LightpageError as error:
            click.echo(f"recalibration: {error}")
        phase("recalibrated", pairs[1], 0.5)
        phase("overload", pairs[1], 4.0)
