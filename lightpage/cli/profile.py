"""`lightpage profile`: make a device's profile, check it, and see what follows from it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import click

from lightpage.cli.groups import Group
from lightpage.cli.options import JSON, new_file
from lightpage.device.profile import Profile, load_profile
from lightpage.device.profile_keys import commented_toml, key_table
from lightpage.device.profile_keys import keys as all_keys
from lightpage.errors import ProfileError, raised_as
from lightpage.files import replace_text, write_json
from lightpage.progress import warn
from lightpage.recording.reader import Recording
from lightpage.waves.consequences import Consequences, consequences
from lightpage.waves.grid import check_camera

_NAME = click.argument("name", metavar="PROFILE")


@click.group(cls=Group)
def profile() -> None:
    """Make the profile of a device, check it, and see what follows from it."""


@profile.command()
@new_file("The file to fill in, TOML.")
@click.option("--like", default="bench", show_default=True, metavar="P", help="Profile whose numbers it starts with.")
def new(out: Path, like: str) -> None:
    """Write a profile with every key and its meaning."""
    replace_text(out, commented_toml(load_profile(like)), "profile")
    click.echo(f"{out}: the numbers of {like}; enter your device's, then: lightpage profile check {out}")


@profile.command()
@JSON
def keys(json_path: Path | None) -> None:
    """Print all keys as a table."""
    write_json(json_path, {"keys": list(map(asdict, all_keys()))})
    click.echo(key_table(), nl=False)


@profile.command()
@_NAME
@JSON
def show(name: str, json_path: Path | None) -> None:
    """Show a profile, and what follows from it."""
    found = load_profile(name)
    told = _write(found, json_path)
    click.echo(f"{found.to_toml()}\n{table(told)}")


@profile.command()
@_NAME
@click.option("--recording", type=click.Path(path_type=Path), help="Recording whose frames it must fit, R.h5.")
@JSON
def check(name: str, recording: Path | None, json_path: Path | None) -> None:
    """Check keys and optics of a profile.

    It says whether the device can be read, and what may cost information. A device that cannot be read makes the exit
    status 2.
    """
    found = load_profile(name)
    told = _write(found, json_path)
    if recording is not None:
        with Recording.open(recording) as file:
            file.header.check_against(found)
    with raised_as(ProfileError, ProfileError, about=f"{name}: "):
        check_camera(found)
    click.echo(table(told))
    for doubt in told.doubts:
        warn(f"profile {name}: {doubt}")


def table(told: Consequences) -> str:
    """Return what follows from a profile as lines for people."""
    return "\n".join(f"{name:<24} {value}" for name, value in _rows(told))


def _rows(told: Consequences) -> Iterator[tuple[str, str]]:
    yield "symbols a page", f"{told.symbols:,}, at most {told.most_bits / 8000:,.4g} kB of 256 levels"
    yield "camera pixels a symbol", f"{told.pixels_per_symbol:.4g} along an edge"
    yield (
        "image on a camera",
        f"{told.image_px[0]} x {told.image_px[1]} pixels, magnification {told.magnification:.4g}",
    )
    yield "aperture", f"{told.aperture:.4g} at the page's corner"
    yield "walls met", f"up to {told.walls_met[0]} along x, {told.walls_met[1]} along y"
    yield "modes of the pipe", f"{told.modes[0]} x {told.modes[1]} carry the page"
    yield "pipe's width", f"{told.carried:.3g} times what a symbol's first order needs"
    yield "a frame pair", f"{told.pair_mb:.3g} MB at 8 bits, {2 * told.pair_mb:.3g} MB above"
    for preset, cost in told.cost.items():
        yield f"decode, {preset}", f"about {cost.seconds:.2g} s a page on two cores, {cost.memory_gb:.2g} GB"


def _write(found: Profile, json_path: Path | None) -> Consequences:
    """Return what follows from a profile, written as JSON too where that is wanted."""
    told = consequences(found)
    write_json(json_path, {"profile": found.model_dump(), **asdict(told)})
    return told
