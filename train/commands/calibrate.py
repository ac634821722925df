"""`lightpage calibrate`: from nominal geometry to this device, with a few pages whose symbols are known."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from pathlib import Path

import click
import numpy as np
import torch

from lightpage.calibration import calibrate as registration
from lightpage.calibration.coherence import seen_share
from lightpage.calibration.document import BlemishCounts, Calibration, load_calibration
from lightpage.calibration.goodness.figure import goodness_figure
from lightpage.calibration.known_pages import first_lit_pages, known_pages, without_blemishes
from lightpage.calibration.likelihood.device_fit import DeviceFit
from lightpage.cli.options import JSON, named_profile, new_file, profile_option
from lightpage.cli.paths import OutputFile
from lightpage.cli.progress_bar import percent_bar
from lightpage.device.profile import Profile
from lightpage.errors import LightpageError
from lightpage.files import replace_file, write_json
from lightpage.pictures import write_figure_png
from lightpage.progress import Progress, warn
from lightpage.recording.pixels.blemishes import Blemishes
from lightpage.recording.reader import Recording
from lightpage.train.data.features import CPU
from lightpage.train.data.torch_engine import torch_device
from lightpage.train.models.field import FieldRecovery, TorchFieldSolver
from lightpage.train.models.likelihood.estimator import PhaseEstimator
from lightpage.train.models.likelihood.torch_likelihood import TorchLikelihood
from lightpage.train.models.twin import RayTwin, TorchTwin

DEFAULT_PAGES = 2
_DOTS = 150
"""Dots of a picture in an inch."""
MAX_PAGES = 4
"""More cost time and add nothing that a decoder would notice."""


@click.command()
@profile_option
@click.option("--recording", required=True, type=click.Path(path_type=Path), help="Pages with known symbols, R.h5.")
@new_file("TOML file to write the calibration to.", read=load_calibration)
@click.option(
    "--pages", default=DEFAULT_PAGES, show_default=True, type=click.IntRange(1, MAX_PAGES), help="Pages used."
)
@click.option(
    "--orientation",
    default="profile",
    show_default=True,
    type=click.Choice(["profile", "any"]),
    help="Orientation of the cameras; `any` takes mirrored or turned ones, each by itself.",
)
@click.option(
    "--picture", type=OutputFile(), help="Draw to this PNG where the light lies that the fit does not explain."
)
@click.option(
    "--compute",
    default="cpu",
    show_default=True,
    metavar="cpu|cuda[:N]",
    help="Processor that recovers the light's field.",
)
@JSON
def calibrate(
    profile_name: str | None,
    recording: Path,
    out: Path,
    pages: int,
    orientation: str,
    picture: Path | None,
    compute: str,
    json_path: Path | None,
) -> None:
    """Find this device's geometry, from nominal, with the first pages of a recording that show light.

    The fit is called good where a decoder loses less than 0.1 bit a symbol by what it leaves unexplained, usable
    below 0.3, else wrong. A wrong one is written too, but over no better one, and ends the command with an error.
    """
    start, device = time.perf_counter(), torch_device(compute)
    with Recording.open(recording) as file, percent_bar() as progress:
        profile = file.header.device(named_profile(profile_name))
        chosen = first_lit_pages(file, pages, warn)
        calibration = calibrate_recording(
            file, profile, chosen, progress, any_orientation=orientation == "any", compute=device
        )
    seconds = time.perf_counter() - start
    kept = calibration.is_wrong and _is_better(out)
    if not kept:
        calibration.save(out)
    lost = int(np.sum(seen_share(TorchTwin(RayTwin(profile)), calibration.vector, profile) < 0.5))
    if json_path is not None:
        write_json(json_path, figures(calibration, profile, seconds, lost))
    click.echo(table(calibration, profile))
    if lost:
        total = profile.page.columns * profile.page.rows
        what = f"{lost} of {total} symbols: most of their light misses a camera, so little of them can be read"
        warn(what)
    if calibration.blemishes is not None and str(calibration.blemishes):
        click.echo(f"\n{calibration.blemishes}")
    found = calibration.goodness
    if picture is not None and found is not None:
        replace_file(picture, lambda file: write_figure_png(file, goodness_figure(found), dpi=_DOTS), "picture")
    click.echo(
        f"\ncoherence {calibration.coherence_before:.3f} -> {calibration.coherence_after:.3f}, "
        f"{calibration.pages_used} known pages, {seconds:.0f} s; {'not ' * kept}written to {out}"
    )
    if found is not None and found.verdict == "good":
        click.echo(f"a good fit: about {found.bits_lost:.2f} bit a symbol lost to light that it does not explain")
    remedy = "the file keeps a better one: name another --out" if kept else "the file is there to be looked at"
    calibration.check_good(f"calibration {out}", f"; {remedy}")


def _is_better(earlier: Path) -> bool:
    """Return whether a file holds a calibration that is not wrong."""
    try:
        return earlier.is_file() and not load_calibration(earlier).is_wrong
    except LightpageError:
        return False


def calibrate_recording(
    recording: Recording,
    profile: Profile,
    pages: Sequence[int],
    progress: Progress,
    *,
    any_orientation: bool = False,
    compute: torch.device = CPU,
    near: Calibration | None = None,
) -> Calibration:
    """Calibrate with some pages of a recording.

    Args:
        recording: recording with known symbols.
        profile: nominal device.
        pages: numbers of the pages.
        progress: called at the beginning of each stage, and with its finished share.
        any_orientation: whether mirrored or turned cameras are accepted.
        compute: processor that recovers the light's field.
        near: earlier calibration of the same device, from which the fit starts; from nominal if left out.

    Raises:
        RecordingError: no symbols, no such page, or a recording of another profile.
        CalibrationError: nothing within the capture range, or near the earlier calibration, explains the frames.
    """
    recording.header.check_against(profile)
    twin = TorchTwin(RayTwin(profile))
    blemishes = Blemishes.of(recording.references())
    known = without_blemishes(known_pages(recording, profile, pages), blemishes)
    solver = TorchFieldSolver(FieldRecovery(profile).to(compute))
    device = twin, solver, profile, blemishes.references, known
    if near is None:
        registered = registration.calibrate(*device, progress, any_orientation=any_orientation)
    else:
        registered = registration.refine(*device, near.vector, near.turn_rad, progress, near.modulator, judged=False)
    hashes = [recording.page_hash(page) for page in pages]
    counts = BlemishCounts.of(blemishes)
    if registered.conditions is None:
        return Calibration.from_registered(registered, profile, hashes, blemishes=counts)
    fit = DeviceFit(
        TorchLikelihood(PhaseEstimator(profile, registered.parameters).eval()),
        twin,
        profile,
        blemishes.references,
        known,
        lambda share: progress("likelihood of all known pages", share),
    )
    refined, statistics = fit.refined(registered, registered.conditions)
    return Calibration.from_registered(refined, profile, hashes, statistics, counts)


def figures(calibration: Calibration, profile: Profile, seconds: float, lost: int) -> dict[str, object]:
    """The result under the names that other programs read; `lost` symbols have most of their light beside a camera."""
    return {
        "angle_deg": calibration.angle_deg(profile),
        "pages_used": calibration.pages_used,
        "seconds": seconds,
        "coherence_before": calibration.coherence_before,
        "coherence_after": calibration.coherence_after,
        "turn_deg": float(np.rad2deg(calibration.turn_rad)),
        "turn_deviation_deg": calibration.turn_deviation_rad and math.degrees(calibration.turn_deviation_rad),
        "parameters": calibration.parameters,
        "modulation": calibration.modulation,
        "symbols_beside_cameras": lost,
        "goodness": None if calibration.goodness is None else calibration.goodness.model_dump(),
        "blemishes": None if calibration.blemishes is None else calibration.blemishes.model_dump(),
    }


_UNITS = frozenset({"m", "rad", "px", "deg", "relative"})


def _label(name: str) -> str:
    """Return the name of a parameter for people, with its unit behind a comma."""
    stem, _, unit = name.rpartition("_")
    return f"{stem.replace('_', ' ')}, {unit}" if unit in _UNITS else name.replace("_", " ")


def table(calibration: Calibration, profile: Profile) -> str:
    """Fitted values with their standard deviations beside the nominal ones, for people."""
    shown = {
        "pipe_angle_rad": ("pipe angle, degree", profile.pipe.angle_deg, 180 / np.pi),
        "focal_length_relative": ("focal length, mm", 1e3 * profile.lens.focal_length_m, None),
        "pipe_length_relative": ("pipe length, mm", 1e3 * profile.pipe.length_m, None),
        "pipe_width_relative": ("pipe width, mm", 1e3 * profile.pipe.width_m, None),
    }
    lines = [f"{'':<32}{'fitted':>12}   {'+-':<10}{'nominal':>10}"]
    for name, value in calibration.parameters.items():
        if name not in calibration.fitted:
            continue
        label, nominal, unit = shown.get(name, (_label(name), 0.0, 1.0))
        factor = nominal if unit is None else unit
        fitted, deviation = nominal + factor * value, factor * calibration.deviations[name]
        lines.append(f"{label:<32}{fitted:>12.6g}   {deviation:<10.2g}{nominal:>10.6g}")
    for name, value in calibration.modulation.items():
        lines.append(f"{_label(name):<32}{value:>12.6g}   {calibration.modulation_deviations[name]:<10.2g}{0:>10.6g}")
    turn, known = math.degrees(calibration.turn_rad), calibration.turn_deviation_rad
    told = "" if known is None else f"{math.degrees(known):.2g}"
    lines.append(f"{'between the arms, degree':<32}{turn:>12.6g}   {told:<10}{'+90 or -90':>10}")
    return "\n".join(lines)
