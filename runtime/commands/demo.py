"""`lightpage demo`: the main job on the simulated device, with the shipped bundle."""

from __future__ import annotations

import time
from pathlib import Path

import click

from lightpage.cli.paths import OutputFile, OutputFolder
from lightpage.cli.progress_bar import percent_bar
from lightpage.errors import InvalidInputError
from lightpage.files import write_json
from runtime.bundle.shipped import DEFAULT, bundle_path
from runtime.demo.demo import AIR_LEVELS, LEVELS, DemoResult, run_demo


@click.command()
@click.option("--bundle", default=DEFAULT, show_default=True, help="A bundle's path, or the name of a shipped one.")
@click.option("--out", default="out/demo", show_default=True, type=OutputFolder(), help="Folder.")
@click.option("--pages", default=3, show_default=True, type=click.IntRange(1, 100), help="Pages in each state.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(0), help="Of what is written.")
@click.option("--json", "json_path", type=OutputFile(), help="Also write the figures to this file.")
def demo(bundle: str, out: Path, pages: int, seed: int, json_path: Path | None) -> None:
    """Decode pages of the simulated device through a service, let the device drift, recalibrate, decode again.

    Writes demo.json and demo.png (frames, confidence, AIR in each state) to the folder --out.
    """
    from runtime.demo.figure import write_figure  # matplotlib takes long to import

    start = time.perf_counter()
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInputError(f"--out {out}", error, "a folder that can be written") from None
    with percent_bar() as progress:
        result = run_demo(bundle_path(bundle), pages, seed, progress)
    figures = result.to_json() | {"seconds": time.perf_counter() - start}
    write_json(out / "demo.json", figures)
    if json_path is not None:
        write_json(json_path, figures)
    write_figure(result, out / "demo.png")
    click.echo(describe(result))
    click.echo(f"\nwritten to {out}: demo.json, demo.png ({figures['seconds']:.0f} s)")


def describe(result: DemoResult) -> str:
    """The figures as a table for people."""
    lines = [
        f"{'device':<16}{'model':<16}{'AIR, bit/symbol*':>17}{'confidence':>12}{'error rate':>12}{'decode, ms':>12}"
    ]
    lines += [
        f"{phase.name:<16}{phase.model_version:<16}{phase.air_bits_per_symbol:>17.3f}{phase.confidence.mean():>12.3f}"
        f"{phase.symbol_error_rate:>12.4f}{1e3 * phase.seconds:>12.0f}"
        for phase in result.phases
    ]
    found = result.recalibrated
    angle = "" if found.angle_deg is None else f", pipe angle {found.angle_deg:.3f} degree"
    lines.append(f"\nrecalibrated with {found.pages_used} known pages in {found.seconds:.0f} s{angle}")
    lines.append(f"* what a phase carries, counted in {AIR_LEVELS} levels; the pages hold {LEVELS}, as confidence does")
    return "\n".join(lines)
