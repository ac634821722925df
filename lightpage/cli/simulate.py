"""`lightpage simulate`: record pages of a simulated device, page by page, so that an interruption loses nothing."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import click

from lightpage.cli.options import JSON, named_profile
from lightpage.cli.paths import OutputFile, check_new
from lightpage.device.profile import Profile
from lightpage.device.state import Device, load_device
from lightpage.errors import InvalidInputError
from lightpage.files import write_json
from lightpage.page.levels import MAX_LEVELS, MIN_LEVELS
from lightpage.progress import note
from lightpage.recording.pages import Pages
from lightpage.simulator.engine import CPU
from lightpage.simulator.recording_job import RecordingJob


@click.command()
@click.option(
    "--profile",
    "profile_name",
    metavar="P",
    help="Nominal device: a shipped name or a file.  [default: that of --symbols]",
)
@click.option("--pages", type=click.IntRange(min=1), help="Number of pages of random symbols.")
@click.option("--symbols", type=click.Path(path_type=Path), help="Pages to write, PAGES.h5, as `encode` makes them.")
@click.option("--out", required=True, type=OutputFile(), help="The recording, R.h5.")
@click.option(
    "--levels",
    type=click.IntRange(MIN_LEVELS, MAX_LEVELS),
    show_default=f"{MAX_LEVELS}, or those of --symbols",
    help="Level count M of random symbols.",
)
@click.option(
    "--seed", default=0, show_default=True, type=click.IntRange(min=0), help="Seed of symbols, noise and drift."
)
@click.option(
    "--device",
    "device_file",
    type=click.Path(),
    help="State of the device: `rough`, or TOML; if absent a realistic one, a pipe 0.6 degree below the profile's.",
)
@click.option("--set", "settings", multiple=True, metavar="TABLE.KEY=VALUE", help="Change one number of that state.")
@click.option(
    "--compute",
    default=CPU,
    show_default=True,
    metavar="cpu|cuda[:N]",
    help="Processor that computes pages; a GPU needs torch, gives the same light, and draws other noise.",
)
@click.option("--truth/--no-truth", default=True, help="Keep what only a simulator knows beside the pages.")
@click.option("--force", is_flag=True, help="Overwrite a recording that exists, or pages begun with other settings.")
@JSON
def simulate(
    profile_name: str | None,
    pages: int | None,
    symbols: Path | None,
    out: Path,
    levels: int | None,
    seed: int,
    device_file: str | None,
    settings: tuple[str, ...],
    compute: str,
    truth: bool,
    force: bool,
    json_path: Path | None,
) -> None:
    """Record pages of a simulated device.

    Interrupted, the same command goes on where it stopped, and the recording is the same as without interruption.
    """
    profile = named_profile(profile_name)
    if out.is_dir():
        raise InvalidInputError(f"--out {out}", "a folder", "a file")
    check_new(out, force)
    if (pages is None) == (symbols is None):
        got = "neither --pages nor --symbols" if pages is None else "both --pages and --symbols"
        raise InvalidInputError("options", got, "one of them")
    with ExitStack() as stack:
        written = None if symbols is None else stack.enter_context(Pages.open(symbols))
        if written is not None and levels not in (None, written.levels):
            raise InvalidInputError("--levels", levels, f"{written.levels}, as {symbols} has, or nothing")
        many = levels or MAX_LEVELS if written is None else written.levels
        if written is not None:
            written.check()
            profile = written.device(profile)
        if profile is None:
            raise InvalidInputError("options", "no --profile", "one, or --symbols with pages that carry it")
        device = _true_device(profile, device_file, settings)
        job = RecordingJob(profile, device, many, seed, truth, out, written, compute)
        count = pages or len(written or ())
        job.check_room(count)
        job.claim(force)
        job.run(count)
    made = {"recording": str(out), "pages": count, "levels": many, "seed": seed, "profile": profile.name}
    write_json(json_path, made)


def _true_device(profile: Profile, device_file: str | None, settings: tuple[str, ...]) -> Device:
    """Return the simulated device's true state; a profile of another pipe angle is told."""
    device = (load_device(device_file) if device_file else Device()).of_profile(profile).with_settings(list(settings))
    if profile.pipe.angle_deg:
        angle = device.geometry.pipe_angle_deg
        note(f"the true pipe is at {angle:g} degree, its profile's at {profile.pipe.angle_deg:g} (--set, --device)")
    return device
