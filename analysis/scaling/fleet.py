"""A fleet of simulated devices that have drifted, recalibrated by `lightpage bulk recalibrate`, against their truth.

    python -m analysis.scaling.fleet --devices 30 --out FOLDER --json FILE
    python -m analysis.scaling.fleet --devices 30 --deep 2 --out FOLDER --json FILE

Every device has drifted from what the shipped bundle says in a direction of its own, and its image has moved. The last
but one is poisoned: its pages carry the symbols of other pages. The last one shows noise. The new bundles are measured
on pages that they have not seen, against the same network that is fed the table of the device's true state. With
`--deep`, some more devices have the kept network of the comparison; they are recalibrated in both forms. What is done
is kept, so that an interrupted run goes on.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

import click
import h5py
import numpy as np

from analysis.comparison.data_set import data_set_of
from analysis.comparison.kept_bundle import export_kept
from analysis.hardware.drifting import TrueTable, Truth, direction, moved
from analysis.hardware.rows import append_row, kept_rows
from lightpage.cli.main import EXIT_AGAIN, EXIT_ERROR
from lightpage.cli.main import run as run_command
from lightpage.cli.paths import OutputFile, OutputFolder
from lightpage.device.profile import Profile, load_profile
from lightpage.device.state import Device
from lightpage.errors import LightpageError
from lightpage.files import write_json
from lightpage.helper_process import same_packages
from lightpage.page.pilots import Pilots
from lightpage.progress import track
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.coded_pages import air_bits
from lightpage.runtime.archives.run.totals import DeviceState
from lightpage.runtime.model.bundle.shipped import DEFAULT, bundle_path
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.simulator.recording_job import RecordingJob
from lightpage.simulator.simulator import Simulator

LEVELS = 256
KNOWN, HELD_OUT = 3, 5
"""Pages of a device: known ones to recalibrate with, and others to measure on."""

DEEP_KNOWN = 40
"""Known pages of a device that is trained on."""

UNITS = 2.0, 8.0
"""Least and most that a device has drifted, see `analysis.hardware.drifting.UNITS`."""

IMAGE_PX = 4.0
"""The most that its image has moved along an axis, camera pixels."""

WANTED = 0.98
"""AIR of a recalibrated device over that of the same network with the true table."""

KEPT = Path(__file__).parents[1] / "weights" / "bench" / "-0.6deg-32e-4px"
"""Data set of the kept network that is trained on."""

LIMIT_S = 24 * 3600.0
_POISONED, _NOISE = "poisoned", "noise"


@dataclass(frozen=True)
class Simulated:
    """A device of the fleet.

    Attributes:
        name: of it.
        seed: of its drift, pages and noise.
        profile: the nominal device.
        before: its state as its bundle has it.
        folder: of its recordings.
        known: how many known pages it has.
    """

    name: str
    seed: int
    profile: Profile
    before: Device
    folder: Path
    known: int = KNOWN

    @property
    def state(self) -> Device:
        """What it is now."""
        rng = np.random.default_rng([self.seed, 2])
        drifted = moved(self.before, direction(self.seed) * rng.uniform(*UNITS))
        shifts = zip("xy", rng.uniform(-IMAGE_PX, IMAGE_PX, 2), strict=True)
        data = drifted.model_dump()
        settings = [
            f"{camera}.shift_{axis}_px={float(data[camera][f'shift_{axis}_px']) + float(by)!r}"
            for axis, by in shifts
            for camera in ("in_phase_camera", "quadrature_camera")
        ]
        return drifted.with_settings(settings)

    @property
    def recording(self) -> Path:
        """Its known pages."""
        return self.folder / f"{self.name}.h5"

    @property
    def held_out(self) -> Path:
        """Its other pages, with what only a simulator knows."""
        return self.folder / f"{self.name}-held-out.h5"

    def make(self) -> None:
        """Simulate what is missing; a poisoned device and noise are spoilt before they get their names."""
        for path, pages, seed in (
            (self.recording, self.known, 2 * self.seed),
            (self.held_out, HELD_OUT, 2 * self.seed + 1),
        ):
            if path.exists():
                continue
            begun = path.with_name(f"{path.stem}-begun.h5")
            if not begun.exists():
                job = RecordingJob(self.profile, self.state, LEVELS, seed, path == self.held_out, begun)
                job.claim(force=False)
                job.run(pages)
            with h5py.File(str(begun), "r+") as file:
                if self.name == _POISONED:
                    file["symbols"][:] = np.roll(file["symbols"][()], 1, axis=0)
                elif self.name == _NOISE:
                    rng = np.random.default_rng(self.seed)
                    for name in ("in_phase", "quadrature"):
                        file[name][:] = rng.integers(0, 128, file[name].shape, np.uint8)
            begun.rename(path)

    def air(self, old: Decoder, bundles: dict[str, str]) -> dict[str, Any]:
        """Mean AIR of its held-out pages by bundle, bits a symbol; `true` is the old network with the true table."""
        decoders = {"before": old} | {name: Decoder.load(path, old.threads) for name, path in bundles.items()}
        true = TrueTable(old)
        airs: dict[str, list[float]] = {"true": []}
        with Recording.open(self.held_out) as recording, h5py.File(str(self.held_out), "r") as file:
            shifts = file["truth/shift_px"][()]
            simulator = Simulator(self.profile, self.state, LEVELS, 2 * self.seed + 1)
            shown = [recording.shown(page) for page in range(recording.pages)]
            for (pair, symbols), (x, y) in zip(shown, shifts, strict=True):
                assert symbols is not None  # it has been simulated
                truth = Truth(symbols, pair, self.state, (float(x), float(y)), simulator.references)
                airs["true"].append(true.air(truth, LEVELS))
            for name, decoder in decoders.items():
                tracker, airs[name] = tracker_for(decoder), []
                for pair, symbols in shown:
                    assert symbols is not None
                    pilots = Pilots.of_symbols(decoder.bundle.pilot_mask, symbols, LEVELS)
                    try:
                        page = tracker.decode(pair, LEVELS, pilots)
                        airs[name].append(air_bits(page, symbols, ~decoder.bundle.pilot_mask, LEVELS))
                    except LightpageError:
                        airs[name].append(0.0)
        return {name: fmean(values) for name, values in airs.items()}


def fleet_file(path: Path, devices: Sequence[Simulated], bundle: Path, run: Path | None = None) -> Path:
    """Write the file that names the devices."""
    tables = []
    for device in devices:
        lines = ["[[device]]", f'name = "{device.name}"', f'bundle = "{bundle.resolve()}"']
        lines += [f'recordings = ["{device.recording.resolve()}"]']
        lines += [] if run is None else [f'run = "{run.resolve()}"']
        tables.append("\n".join(lines))
    path.write_text("\n\n".join(tables) + "\n")
    return path


def recalibrated(folder: Path, fleet: Path, options: Sequence[str], threads: int) -> list[dict[str, Any]]:
    """What `lightpage bulk recalibrate` says of each device; it goes on where it was."""
    told = folder.with_suffix(".json")
    command = [sys.executable, "-m", "lightpage.cli.main", "bulk", "recalibrate", str(folder), "--fleet", str(fleet)]
    environment = same_packages(threads)
    done = subprocess.run(
        [*command, "--json", str(told), "--threads", str(threads), *options],
        env=environment,
        timeout=LIMIT_S,
        check=False,
    )
    if done.returncode not in (0, EXIT_ERROR, EXIT_AGAIN):  # devices are refused, or have failed
        raise RuntimeError(f"lightpage bulk recalibrate ended with status {done.returncode}")
    devices: list[dict[str, Any]] = json.loads(told.read_text())["devices"]
    return devices


def measured(
    devices: Sequence[Simulated], made: dict[str, dict[str, str]], old: Decoder, kept: Path
) -> list[dict[str, Any]]:
    """A row for each device that has new bundles, from its file where it is there."""
    rows = {row["device"]: row for row in kept_rows(kept)}
    for device in track([each for each in devices if made.get(each.name)], "measure", unit="device"):
        if device.name not in rows:
            row = {"device": device.name} | device.air(old, made[device.name])
            append_row(kept, row)
            rows[device.name] = row
    return [rows[device.name] for device in devices if device.name in rows]


def _bundles(rows: Sequence[dict[str, Any]], form: str) -> dict[str, dict[str, str]]:
    return {row["device"]: {form: row["bundle"]} for row in rows if row["state"] == DeviceState.RECALIBRATED}


def quick(devices: int, out: Path, workers: int, threads: int) -> dict[str, Any]:
    """The quick form on the whole fleet."""
    profile = load_profile("bench")
    names = [*(f"device-{number:02}" for number in range(1, devices - 1)), _POISONED, _NOISE]
    fleet = [Simulated(name, 100 + number, profile, Device(), out) for number, name in enumerate(names)]
    for device in track(fleet, "simulate", unit="device"):
        device.make()
    bundle = bundle_path(DEFAULT)
    file = fleet_file(out / "fleet.toml", fleet, bundle)
    found = recalibrated(out / "quick", file, ("--workers", str(workers)), threads)
    rows = measured(fleet, _bundles(found, "quick"), Decoder.load(bundle, threads), out / "quick-measured.jsonl")
    ratios = [row["quick"] / row["true"] for row in rows]
    return {
        "devices": found,
        "measured": rows,
        "least_ratio": min(ratios, default=None),
        "mean_ratio": fmean(ratios) if ratios else None,
        "reached": sum(ratio >= WANTED for ratio in ratios),
        "failed": {row["device"]: row["reason"] for row in found if row["state"] != DeviceState.RECALIBRATED},
    }


def deep(devices: int, steps: int, out: Path, threads: int) -> dict[str, Any]:
    """Both forms on devices whose network may be trained on."""
    profile, before, _ = data_set_of(KEPT)
    run, bundle = out / "kept", out / "kept.zip"
    if not bundle.exists():
        export_kept(KEPT, run, bundle)
    fleet = [
        Simulated(f"deep-{number}", 500 + number, profile, before, out, DEEP_KNOWN) for number in range(1, devices + 1)
    ]
    for device in track(fleet, "simulate", unit="device"):
        device.make()
    file = fleet_file(out / "fleet-deep.toml", fleet, bundle, run)
    one = ("--workers", "1")
    found = recalibrated(out / "deep-quick", file, one, threads)
    trained = recalibrated(out / "deep", file, (*one, "--deep", "--steps", str(steps)), threads)
    made = _bundles(found, "quick")
    for name, bundles in _bundles(trained, "deep").items():
        made[name] = made.get(name, {}) | bundles
    rows = measured(fleet, made, Decoder.load(bundle, threads), out / "deep-measured.jsonl")
    return {"steps": steps, "known_pages": DEEP_KNOWN, "quick": found, "deep": trained, "measured": rows}


@click.command()
@click.option("--devices", default=30, show_default=True, type=click.IntRange(3), help="Two of which are spoilt.")
@click.option("--deep", "deep_devices", default=0, show_default=True, type=click.IntRange(0), help="More of them.")
@click.option("--steps", default=300, show_default=True, type=click.IntRange(10), help="With --deep.")
@click.option("--workers", default=1, show_default=True, type=click.IntRange(1))
@click.option("--threads", default=1, show_default=True, type=click.IntRange(1), help="Of a worker.")
@click.option("--out", required=True, type=OutputFolder(), help="Recordings, bundles and figures; gone on with.")
@click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file.")
def main(
    devices: int, deep_devices: int, steps: int, workers: int, threads: int, out: Path, json_path: Path | None
) -> None:
    """Print what each device reads before and after, and over the true table; and which devices failed, and why."""
    out.mkdir(parents=True, exist_ok=True)
    figures: dict[str, Any] = {"fleet": quick(devices, out, workers, threads)}
    fleet = figures["fleet"]
    for row in fleet["measured"]:
        click.echo(
            f"{row['device']:<12} before {row['before']:.3f}, recalibrated {row['quick']:.3f}, true table "
            f"{row['true']:.3f}: {row['quick'] / row['true']:.4f}"
        )
    for name, reason in fleet["failed"].items():
        click.echo(f"{name:<12} {reason}")
    least = fleet["least_ratio"]
    click.echo(f"{fleet['reached']} of {devices - 2} devices reach {WANTED:.0%} of the true table; least {least}")
    if deep_devices:
        figures["deep"] = deep(deep_devices, steps, out, threads)
        for row in figures["deep"]["measured"]:
            click.echo(
                ", ".join(
                    f"{name} {value if isinstance(value, str) else f'{value:.3f}'}" for name, value in row.items()
                )
            )
    if json_path is not None:
        write_json(json_path, figures)


if __name__ == "__main__":
    sys.exit(run_command(main, name="python -m analysis.scaling.fleet"))
