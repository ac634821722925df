"""SIGKILL at random points of a recalibration and of a change of model: does the next start serve what it should?

    python -m analysis.attacks.kills --kills 100 --out FOLDER --json FILE

A service with a store recalibrates itself from a recording, or changes between its models, and is killed at a random
moment. The next one must start; the model that it serves must be the last that a caller heard of, or the one that was
asked for and not yet heard of; the record of model changes and the jobs must say the same; it must read a page right;
and nothing half-written may be left in the store or in the temporary folder.
"""

from __future__ import annotations

import json
import random
import sys
import threading
from pathlib import Path
from typing import Any

import click
import grpc
import numpy as np

from analysis.service.running import RunningService
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile, OutputFolder
from lightpage.device.profile import load_profile
from lightpage.device.state import Device
from lightpage.errors import LightpageError
from lightpage.metrics.provenance import write_figures
from lightpage.page.symbols import random_symbols
from lightpage.progress import track
from lightpage.recording.writer import RecordingWriter
from lightpage.runtime.client.answers import JobState
from lightpage.runtime.client.client import LightpageClient
from lightpage.simulator.simulator import Simulator

_LEVELS, _PAGES = 16, 3
_ANGLE_DEG = -0.57
_KNOWN = frozenset([".lock"])
"""Hidden files of a store that belong there."""


def simulated(path: Path) -> Path:
    """A recording with known symbols of the shipped bundle's device after it has drifted; made once."""
    if path.exists():
        return path
    profile, device = load_profile("bench"), Device()
    drifted = device.geometry.model_copy(update={"pipe_angle_deg": _ANGLE_DEG})
    device = device.model_copy(update={"geometry": drifted})
    simulator = Simulator(profile, device, _LEVELS, 1)
    symbols = random_symbols(profile, _LEVELS, _PAGES, np.random.default_rng(1))
    bits = device.sensor.bit_depth
    with RecordingWriter(path, profile, _LEVELS, bits, simulator.references(), resume=True) as writer:
        for number in track(range(writer.pages, _PAGES), "simulate", total=_PAGES):
            writer.append(symbols[number], simulator.page(symbols[number]))
    return path


class Killed:
    """A service that is asked for something, and killed.

    Args:
        out: has the recording, the store and the temporary folder.
    """

    def __init__(self, out: Path) -> None:
        self.store, self.temporary = out / "store", out / "tmp"
        self.temporary.mkdir(parents=True, exist_ok=True)
        self._arguments = ("--source", f"recording:{out / 'known.h5'}", "--store", str(self.store), "--threads", "1")
        self.bad: list[str] = []
        self.heard = self.unheard = 0

    def start(self) -> RunningService:
        """The next service."""
        return RunningService(*self._arguments, environment={"TMPDIR": str(self.temporary)}).start()

    def begin(self) -> None:
        """Recalibrate once to the end: without a second model there would be nothing to change between."""
        with self.start() as service, LightpageClient(service.target) as client:
            client.jobs.recalibrate(count=2)

    def check(self, service: RunningService, expected: set[str]) -> str:
        """Look at what the service that came after a kill serves, and note whatever should not be."""
        with LightpageClient(service.target, 60) as client:
            version = client.describe().model.version
            if version not in expected:
                self.bad.append(f"{version} serves in place of {' or '.join(sorted(expected))}")
            changes = [json.loads(line) for line in (self.store / "audit.jsonl").read_text().splitlines()]
            if (noted := [change["to"] for change in changes if change["outcome"] == "done"][-1]) != version:
                self.bad.append(f"{version} serves, and the record says {noted}")
            made = {change["to"] for change in changes if change["what"] == "recalibrate"}
            for job in client.jobs.list():
                if job.state is JobState.RUNNING or (job.result is not None and job.result.model_version not in made):
                    self.bad.append(f"job {job.id} is {job.state}, and the record says {', '.join(sorted(made))}")
            page = client.pages.read(want_written=True)
            assert page.written is not None  # the recording knows
            errors = float(np.mean(page.symbols != page.written))
            if errors > 0.05:
                self.bad.append(f"{version} reads {errors:.1%} of the symbols wrong")
        hidden = {path.name for path in self.store.iterdir() if path.name.startswith(".")} - _KNOWN
        left = {path.name for path in self.temporary.iterdir()}
        if hidden or left:
            self.bad.append(f"left behind: {', '.join(sorted(hidden | left))}")
        return version

    def once(self, chance: random.Random, longest_s: float) -> None:
        """Start, ask, kill, start again and look."""
        with self.start() as service:
            heard: list[str] = []
            asked: list[str] = []
            with LightpageClient(service.target, 60) as client:
                before = client.describe().model.version
                models = client.models.list(stored=True)
                versions = [model.version for model in models]
                recalibrating = chance.random() < 0.5 or len(versions) < 2

                def ask() -> None:
                    try:
                        if recalibrating:  # the base: another time would bring no more
                            asked.extend(model.version for model in models if model.origin == "given")
                            heard.append(client.models.activate(asked[-1])[0])
                            heard.append(client.jobs.recalibrate(count=2).model_version)
                        while not recalibrating:
                            asked.append(chance.choice(versions))
                            heard.append(client.models.activate(asked[-1])[0])
                    except (LightpageError, grpc.RpcError, ValueError):
                        pass  # the service has gone

                asking = threading.Thread(target=ask)
                asking.start()
                threading.Event().wait(chance.random() * (longest_s if recalibrating else 2.0))
                known = list(heard)
                service.kill()
                asking.join()
        with self.start() as service:
            with LightpageClient(service.target, 60) as client:
                now = {model.version for model in client.models.list(stored=True)}
            last = heard[-1] if heard else before
            possible = {last, *(now - set(versions)), *asked[-1:]}
            self.heard += bool(known)
            self.unheard += self.check(service, possible) != last


@click.command()
@click.option("--kills", default=100, show_default=True, type=click.IntRange(1))
@click.option("--seed", default=0, show_default=True, type=click.IntRange(0))
@click.option("--longest", "longest_s", default=12.0, show_default=True, help="Seconds that a recalibration may take.")
@click.option("--out", required=True, type=OutputFolder(), help="Recording, store and temporary files.")
@click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file.")
def main(kills: int, seed: int, longest_s: float, out: Path, json_path: Path | None) -> None:
    """Print starts that failed or served a wrong model, and what was left behind."""
    out.mkdir(parents=True, exist_ok=True)
    simulated(out / "known.h5")
    killed, chance = Killed(out), random.Random(seed)
    failed: list[str] = []
    killed.begin()
    for _ in track(range(kills), "kills", total=kills):
        try:
            killed.once(chance, longest_s)
        except RuntimeError as error:
            failed.append(str(error))
    figures: dict[str, Any] = {
        "kills": kills,
        "failed_starts": failed,
        "bad": killed.bad,
        "after_a_change": killed.heard,
        "unheard_changes": killed.unheard,
    }
    click.echo(
        f"{kills} kills: {len(failed)} starts failed, {len(killed.bad)} served or left what they should not; "
        f"{killed.heard} came after a change, {killed.unheard} before its caller heard of it"
    )
    for each in (failed + killed.bad)[:10]:
        click.echo(f"  {each}")
    if json_path is not None:
        write_figures(json_path, figures)


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.attacks.kills"))
