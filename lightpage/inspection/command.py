"""`lightpage inspect`: what a file is, how it fits a device, and what can be done with it next."""

from __future__ import annotations

from pathlib import Path

import click

from lightpage.cli.main import EXIT_ERROR
from lightpage.cli.options import JSON, named_profile
from lightpage.cli.paths import OutputFile
from lightpage.files import write_json
from lightpage.inspection.apart import look_apart
from lightpage.inspection.exposure import bars
from lightpage.inspection.finding import Finding, printable


@click.command()
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--profile", "profile_name", metavar="P", help="Check the fit to this profile too.")
@click.option("--picture", type=OutputFile(), help="Draw frames, references, fringes, a page and exposure to this PNG.")
@JSON
def inspect(file: Path, profile_name: str | None, picture: Path | None, json_path: Path | None) -> None:
    """Say what FILE is, what is wrong with it, and what can be done with it next.

    FILE is a recording, pages, a bundle, the folder of a run, a calibration, a profile, or frames of another program:
    a file, FILE::NAME, a folder of pictures, or a pattern in quotes. Frames are looked at by samples. What is broken or
    does not fit makes the exit status 2.
    """
    found, pictures = look_apart(file, named_profile(profile_name), drawn=picture is not None)
    write_json(json_path, found.to_json())
    click.echo(table(found))
    if picture is not None:
        from lightpage.inspection.picture import draw  # matplotlib takes half a second

        draw(found, pictures, picture)
    if found.problems:
        click.get_current_context().exit(EXIT_ERROR)


def _told(value: object) -> str:
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def table(found: Finding) -> str:
    """Return what was found as lines for people."""
    rows = [f"{printable(str(found.path))}: {found.kind}"]
    rows += [f"  {printable(name):<32} {printable(_told(value))}" for name, value in found.facts.items()]
    for name, each in found.histograms.items():
        rows += [f"counts of {name}, full scale {each.full_scale}, {each.saturated:.2%} there:", *bars(each)]
    rows += [f"problem: {printable(problem)}" for problem in found.problems]
    rows += [f"next: {printable(command)}" for command in found.next]
    return "\n".join(rows)
