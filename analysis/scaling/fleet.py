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
from pathlib import Path
from statistics import fmean
from typing import Any

import click

from analysis.comparison.data_set import data_set_of
from analysis.comparison.kept_bundle import export_kept
from analysis.hardware.rows import append_row, kept_rows
from analysis.scaling.fleet_device import NOISE, POISONED, FleetDevice
from lightpage.cli.main import EXIT_AGAIN, EXIT_ERROR
from lightpage.cli.main import run as run_command
from lightpage.cli.paths import OutputFile, OutputFolder
from lightpage.device.profile import load_profile
from lightpage.device.state import Device
from lightpage.helper_process import same_packages
from lightpage.metrics.provenance import write_figures
from lightpage.progress import track
from lightpage.runtime.archives.run.totals import DeviceState
from lightpage.runtime.model.bundle.shipped import DEFAULT, bundle_path
from lightpage.runtime.model.decoding.decoder import Decoder

DEEP_KNOWN = 40
"""Known pages of a device that is trained on."""

WANTED = 0.98
"""AIR of a recalibrated device over that of the same network with the true table."""

KEPT = Path(__file__).parents[1] / "weights" / "bench" / "-0.6deg-32e-4px"
"""Data set of the kept network that is trained on."""

LIMIT_S = 24 * 3600.0


def fleet_file(path: Path, devices: Sequence[FleetDevice], bundle: Path, run: Path | None = None) -> Path:
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
    """Run or resume `lightpage bulk recalibrate`, and return its report of each device."""
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
    devices: Sequence[FleetDevice], made: dict[str, dict[str, str]], old: Decoder, kept: Path
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
    names = [*(f"device-{number:02}" for number in range(1, devices - 1)), POISONED, NOISE]
    fleet = [FleetDevice(name, 100 + number, profile, Device(), out) for number, name in enumerate(names)]
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
    """Recalibrate devices in both forms, where their network may be trained on."""
    profile, before, _ = data_set_of(KEPT)
    run, bundle = out / "kept", out / "kept.zip"
    if not bundle.exists():
        export_kept(KEPT, run, bundle)
    fleet = [
        FleetDevice(f"deep-{number}", 500 + number, profile, before, out, DEEP_KNOWN)
        for number in range(1, devices + 1)
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
@click.option(
    "--steps", default=300, show_default=True, type=click.IntRange(10), help="Steps of training, with --deep."
)
@click.option("--workers", default=1, show_default=True, type=click.IntRange(1))
@click.option("--threads", default=1, show_default=True, type=click.IntRange(1), help="Threads of a worker.")
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
        write_figures(json_path, figures)


if __name__ == "__main__":
    sys.exit(run_command(main, name="python -m analysis.scaling.fleet"))
