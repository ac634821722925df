"""`lightpage simulate`: record pages of a simulated device, page by page, so that an interruption loses nothing."""

from __future__ import annotations

from pathlib import Path

import click

from lightpage.device.profile import load_profile
from lightpage.device.state import Device, load_device
from lightpage.errors import InvalidInputError
from lightpage.page.symbols import MAX_LEVELS, MIN_LEVELS
from lightpage.simulator.recording_job import RecordingJob


@click.command()
@click.option("--profile", "profile_name", required=True, metavar="P", help="Nominal device: a shipped name or a file.")
@click.option("--pages", required=True, type=click.IntRange(min=1), help="How many pages.")
@click.option("--out", required=True, type=click.Path(path_type=Path), help="The recording, R.h5.")
@click.option("--levels", default=MAX_LEVELS, show_default=True, type=click.IntRange(MIN_LEVELS, MAX_LEVELS))
@click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0), help="Of symbols, noise and drift.")
@click.option("--device", "device_file", type=click.Path(), help="True state of the device, TOML; realistic if absent.")
@click.option("--set", "settings", multiple=True, metavar="TABLE.KEY=VALUE", help="Change one number of that state.")
@click.option("--truth/--no-truth", default=True, help="Keep what only a simulator knows beside the pages.")
@click.option("--force", is_flag=True, help="Overwrite a recording that exists, or pages begun with other settings.")
def simulate(
    profile_name: str,
    pages: int,
    out: Path,
    levels: int,
    seed: int,
    device_file: str | None,
    settings: tuple[str, ...],
    truth: bool,
    force: bool,
) -> None:
    """Record pages of a simulated device.

    Interrupted, the same command goes on where it stopped, and the recording is the same as without interruption.
    """
    profile = load_profile(profile_name)
    device = (load_device(device_file) if device_file else Device()).with_settings(list(settings))
    if out.is_dir():
        raise InvalidInputError(f"--out {out}", "a folder", "a file")
    if out.exists() and not force:
        raise InvalidInputError(f"--out {out}", "a file that exists", "a new name, or --force")
    job = RecordingJob(profile, device, levels, seed, truth, out)
    job.claim(force)
    job.run(pages)
