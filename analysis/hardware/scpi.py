"""The pulse generator's serial line under faults: is an answer ever given to the wrong query?

    python -m analysis.hardware.scpi --queries 10000 --json runs/scpi.json

Each query asks for width or delay of a random channel; before half of them a random one is set. Values never repeat, so
an answer tells whose it is. Meanwhile the line cuts, alters, delays, repeats and loses answers, and cuts messages,
each at random; and it is unplugged now and then, with its echo on or off when it is back.
"""

from __future__ import annotations

import re
import statistics
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import click
import numpy as np

from lightpage.cli.main import run
from lightpage.errors import LostShotError
from lightpage.metrics.provenance import write_figures
from lightpage.runtime.device.trigger.scpi_line import ScpiLine
from lightpage.runtime.device.trigger.scpi_port import LineTimes
from lightpage.virtual_device.pulse_generator import CHANNELS, PulseGeneratorEmulator
from lightpage.virtual_device.serial_port import Fault, Pty, TcpPort, VirtualSerialPort

TIMES = LineTimes(answer_s=0.1, quiet_s=0.02, late_s=0.4, synchronise_s=2.0)
LATE_S = (0.02, 0.35)
"""Answers are late by this, some of them still in time."""
AWAY_S = (0.0, 0.15)
"""The port is unplugged for so long."""
AGAIN_S = 0.01
"""Between two attempts after it is back."""
BACK_S = 30.0
"""A line that is not back by then is broken for good."""
_NUMBER = re.compile(r"\d+\.\d+")
_SETTINGS = {"WIDT": "WIDTh", "DEL": "DELay"}


@dataclass
class Outcome:
    """Outcome of the queries.

    Attributes:
        queries: asked.
        right: answered as the device had it.
        wrong_query: answered with a value that belongs to another query.
        altered: answered with a value that belongs to none.
        lost: not answered, by reason and by a fault that there was meanwhile.
        faults: injected, by kind.
        unplugged: how often the line was.
        back_s: time from plugging it in again to the first answer.
        seconds: all of it.
    """

    queries: int = 0
    right: int = 0
    wrong_query: int = 0
    altered: int = 0
    lost: Counter[str] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)
    unplugged: int = 0
    back_s: list[float] = field(default_factory=list)
    seconds: float = 0.0

    def to_json(self) -> dict[str, Any]:
        """The counts, and median and longest time until an answer came again."""
        figures: dict[str, Any] = vars(self) | {"lost": dict(self.lost), "faults": dict(self.faults)}
        figures["back_s"] = {
            "median": statistics.median(self.back_s) if self.back_s else None,
            "longest": max(self.back_s, default=None),
        }
        return figures


class Experiment:
    """A line with faults, and what its answers are worth.

    Args:
        port: port of the emulated device, plugged in.
        device: behind it.
        rate: rate of faults, for each message.
        seed: seed of everything random.
    """

    def __init__(self, port: VirtualSerialPort, device: PulseGeneratorEmulator, rate: float, seed: int) -> None:
        self._random = np.random.default_rng(seed)
        self._port, self._device, self._rate = port, device, rate
        self._fault_random = np.random.default_rng(seed + 1)
        port.late_s, port.fault = LATE_S, self._fault
        self._line = ScpiLine(port.address, times=TIMES)
        self._given: set[float] = set()
        """Every value that a setting was given."""
        self._away = False
        """True until an answer has come after the line was unplugged."""
        for channel in range(1, CHANNELS + 1):
            for setting in _SETTINGS:
                device.answer(self._command(channel, setting))
        self.outcome = Outcome()

    def run(self, queries: int, unplug_every: int) -> Outcome:
        """Ask; unplug in between."""
        begin = time.monotonic()
        plugged: float | None = None
        for number in range(1, queries + 1):
            if number % unplug_every == 0:
                self._replug()
                plugged = time.monotonic()
            answered = self._ask()
            if plugged is None:
                continue
            if answered:
                self.outcome.back_s.append(time.monotonic() - plugged)
                plugged = None
            elif time.monotonic() - plugged > BACK_S:
                raise AssertionError(f"no answer within {BACK_S:g} s of plugging in")
            else:
                time.sleep(AGAIN_S)
        self._line.close()
        self.outcome.faults.update({kind.value: count for kind, count in self._port.faults.items()})
        self.outcome.seconds = time.monotonic() - begin
        return self.outcome

    def _fault(self, message: str) -> Fault | None:
        if self._fault_random.random() >= self._rate:
            return None
        return list(Fault)[self._fault_random.integers(len(Fault))]

    def _replug(self) -> None:
        self._port.unplug()
        self._away = True
        if self._random.random() < 0.5:
            self._ask()  # one that finds nothing there
        time.sleep(self._random.uniform(*AWAY_S))
        self._port.echo = bool(self._random.random() < 0.5)
        self._port.plug()
        self.outcome.unplugged += 1

    def _setting(self) -> tuple[int, str]:
        return int(self._random.integers(1, CHANNELS + 1)), str(self._random.choice(list(_SETTINGS)))

    def _command(self, channel: int, setting: str) -> str:
        """Give a setting a value that none had before."""
        value = 0.0
        while value in self._given or not value:
            value = float(round(self._random.uniform(1e-6, 9.0), 9))
        self._given.add(value)
        return f":PULSE{channel}:{setting} {value:.11f}"

    def _ask(self) -> bool:
        """Ask for a setting, half of the time after one was given a new value; whether that was answered."""
        outcome, faults = self.outcome, dict(self._port.faults)
        outcome.queries += 1
        try:
            if self._random.random() < 0.5:
                self._line.send(self._command(*self._setting()))
            channel, setting = self._setting()
            found = float(self._line.query(f":PULSE{channel}:{setting}?", _NUMBER))
        except LostShotError as error:
            kinds = [kind.value for kind, count in self._port.faults.items() if count > faults[kind]]
            cause = "unplugged" if self._away else kinds[0] if kinds else "what came before"
            outcome.lost[f"{error.reason.value}, {cause}"] += 1
            return False
        self._away = False
        if found == float(self._device.value(channel, _SETTINGS[setting])):
            outcome.right += 1
        elif found in self._given:
            outcome.wrong_query += 1
        else:
            outcome.altered += 1
        return True


@contextmanager
def emulated(kind: str, seed: int) -> Iterator[tuple[VirtualSerialPort, PulseGeneratorEmulator]]:
    """A pulse generator on a pseudo-terminal (``pty``) or a socket (``tcp``)."""
    device = PulseGeneratorEmulator()
    with tempfile.TemporaryDirectory() as folder:
        port: VirtualSerialPort = (
            Pty(device.answer, Path(folder) / "tty", seed) if kind == "pty" else TcpPort(device.answer, seed=seed)
        )
        with port:
            yield port, device


def line(outcome: Outcome) -> str:
    """The outcome for people."""
    figures = outcome.to_json()
    lost = ", ".join(f"{count} {reason}" for reason, count in outcome.lost.most_common())
    faults = ", ".join(f"{count} {kind}" for kind, count in outcome.faults.items())
    back = figures["back_s"]
    times = "" if back["longest"] is None else f", back after {back['median']:.2f} s (longest {back['longest']:.2f} s)"
    return (
        f"{outcome.queries} queries in {outcome.seconds:.0f} s: {outcome.right} right, "
        f"{outcome.wrong_query} answered with another's value, {outcome.altered} with an altered one, "
        f"{sum(outcome.lost.values())} lost ({lost})\n"
        f"faults: {faults}\nunplugged {outcome.unplugged} times{times}"
    )


@click.command()
@click.option("--queries", default=10_000, show_default=True, type=click.IntRange(1))
@click.option("--fault-rate", default=0.05, show_default=True, type=click.FloatRange(0, 0.5), help="Per message.")
@click.option("--unplug-every", default=100, show_default=True, type=click.IntRange(2), help="Queries.")
@click.option("--port", "kind", default="pty", show_default=True, type=click.Choice(["pty", "tcp"]))
@click.option("--seed", default=0, show_default=True, type=click.IntRange(0))
@click.option("--json", "json_path", type=click.Path(dir_okay=False, path_type=Path), help="Write the figures there.")
def main(queries: int, fault_rate: float, unplug_every: int, kind: str, seed: int, json_path: Path | None) -> None:
    """Count answers that a faulty serial line gives to the wrong query."""
    with emulated(kind, seed) as (port, device):
        outcome = Experiment(port, device, fault_rate, seed).run(queries, unplug_every)
    click.echo(line(outcome))
    if json_path is not None:
        options = {"fault_rate": fault_rate, "unplug_every": unplug_every, "port": kind, "seed": seed}
        write_figures(json_path, options | {"times": TIMES.model_dump()} | outcome.to_json())


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.hardware.scpi"))
