"""`lightpage demo`: the main job on the simulated device, with the shipped bundle."""

from __future__ import annotations

import time
from pathlib import Path

import click

from lightpage.cli.options import JSON
from lightpage.cli.paths import OutputFolder
from lightpage.cli.progress_bar import percent_bar
from lightpage.demo.demo import run_demo
from lightpage.demo.result import DemoResult
from lightpage.errors import InvalidInputError
from lightpage.metrics.provenance import write_figures
from lightpage.runtime.archives.recordings.coded_pages import AIR_LEVELS
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.bundle.shipped import DEFAULT, bundle_path


@click.command()
@click.option("--bundle", default=DEFAULT, show_default=True, help="A bundle's path, or the name of a shipped one.")
@click.option(
    "--out", default="out/demo", show_default=True, type=OutputFolder(), help="Folder for what the demo writes."
)
@click.option("--seed", default=0, show_default=True, type=click.IntRange(0), help="Seed of the picture and pages.")
@click.option("--source", "spec", help="A simulated device that runs as hardware, camera:FOLDER/device.toml.")
@click.option(
    "--calibrate/--no-calibrate",
    default=None,
    help="Calibrate the device first by two known pages, with the bundle's graphs; else the bundle must be the "
    "device's own. The default is to calibrate, unless the bundle holds a network.",
)
@JSON
def demo(bundle: str, out: Path, seed: int, spec: str | None, calibrate: bool | None, json_path: Path | None) -> None:
    """Calibrate a simulated device, store a picture, and read it before a drift, after it and after a healing.

    Writes to the folder --out: known.h5 (two known pages), device.zip (the bundle made of them), pages.h5 (what the
    modulator shows), demo.json, demo.png, and the picture as it was read in each state (.pgm).
    """
    from lightpage.demo.figure import write_figure  # matplotlib takes long to import

    start = time.perf_counter()
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInputError(f"--out {out}", error, "a folder that can be written") from None
    model = bundle_path(bundle)
    calibrate = Bundle.open(model).is_estimator if calibrate is None else calibrate
    with percent_bar() as progress:
        result = run_demo(model, out, seed, progress, spec, calibrate=calibrate)
    figures = result.to_json() | {"seconds": time.perf_counter() - start}
    options = {"seed": seed, "source": spec, "calibrate": calibrate}
    for path in (out / "demo.json", json_path):
        write_figures(path, figures, bundle=model, options=options)
    write_figure(result, out / "demo.png")
    click.echo(describe(result))
    known = ", known.h5, device.zip" if calibrate else ""
    click.echo(f"\nwritten to {out}: demo.json, demo.png, pages.h5, pictures{known} ({figures['seconds']:.0f} s)")


def describe(result: DemoResult) -> str:
    """The figures as a table for people."""
    lines = [
        f"{'device':<16}{'model':<16}{'AIR, bit/symbol*':>17}{'margin':>9}{'unread':>8}{'restored':>10}{'lost':>6}"
        f"{'picture':>10}{'decode, ms':>12}"
    ]
    lines += [
        f"{phase.name:<16}{phase.model_version:<16}{phase.air_bits_per_symbol:>17.3f}"
        f"{'' if phase.margin_bits is None else f'{phase.margin_bits:.3f}':>9}{phase.unread:>8}{phase.restored:>10}"
        f"{phase.lost:>6}{'exact' if phase.exact else 'damaged':>10}{1e3 * phase.seconds:>12.0f}"
        for phase in result.phases
    ]
    volume = result.volume
    lines.append(
        f"\na picture of {volume.file_bytes} bytes on {volume.pages} pages, {volume.parity_pages} of each group of "
        f"{volume.group_pages} parity, one page spoilt; {volume.page_bytes} user bytes a page"
    )
    for step in result.drift:
        margin = "" if step.margin_bits is None else f" margin {step.margin_bits:+.3f} bit a symbol,"
        due = ", recalibration due" if step.recalibration_due else ""
        lines.append(f"drift {step.share:.2f}:{margin} page {'lost' if step.lost else 'read'}{due}")
    lines += result.story()[-2:]
    if (calibration := result.calibration) is not None:
        lines.insert(
            0,
            f"calibrated by {calibration.pages} known pages in {calibration.seconds:.0f} s: "
            f"pipe's angle {calibration.angle_deg:.3f} degree\n",
        )
    lines.append(
        f"healed in {result.healed.seconds:.0f} s; {result.healed.pages_used} of the lost pages came right first"
    )
    if result.shots:
        told = ", ".join(f"{count} {outcome}" for outcome, count in sorted(result.shots.items()))
        lines.append(f"shots of {result.source}: {told}")
    lines.append(f"* what a phase carries, counted in {AIR_LEVELS} levels; the pages have {result.code.levels}")
    return "\n".join(lines)
