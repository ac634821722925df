"""Record pages of an imperfect device by the simulator that shares nothing with the project's own.

    python -m analysis.comparison.foreign_recording --device third --out R.h5
    lightpage calibrate --profile bench --recording R.h5 --out C.toml
    lightpage train --profile bench --recording R.h5 --calibration C.toml --preset standard --steps 600 \\
        --synthetic-pages 0 --test-share 0.2 --validation-share 0.07 --out RUN
    lightpage export RUN --out B.zip
    lightpage evaluate --bundle B.zip --recording R.h5

`lightpage calibrate --recording R.h5 --out C.toml --export B.zip` makes a bundle without training. The truth is
printed, as that simulator calls it: lengths are millimetres.
"""

from __future__ import annotations

import sys
from dataclasses import asdict, replace
from pathlib import Path

import click
import numpy as np

from analysis.foreign_device import Camera, ForeignDevice, Parameters, draw_parameters
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile

MM_PER_RAD = 0.3424
"""Distance from a focal plane that makes a radian at the middle of the facet's wall, of the bench device."""
LEVELS = 256

USUAL = Parameters(
    pipe_angle_deg=-0.52,
    focal_length_error=0.001,
    pipe_length_error=-0.002,
    pipe_width_error=0.0002,
    page_centre_px=(2.0, -1.0),
    pipe_roll_deg=0.1,
    in_phase_camera=Camera(scale=0.002, rotation_deg=0.1, shift_px=(3.0, -2.0)),
    quadrature_camera=Camera(scale=-0.002, rotation_deg=-0.05, shift_px=(-2.0, 4.0)),
    distortion=0.001,
    defocus_rad=0.5,
    astigmatism_rad=0.4,
    coma_rad=0.3,
    ripple=0.04,
    tilt_rad=(0.7, -0.5),
    curvature_rad=1.0,
    quadrature_error_deg=3.0,
    quadrature_gain=1.05,
    phase_noise_rad=0.05,
    blur_px=0.2,
    falloff=0.1,
    bit_depth=12,
    piston_drift_rad=0.3,
    shift_drift_px=0.05,
)
"""A device whose numbers are off as on a bench, without a fault of its modulator or its planes."""
DRAWN_SHARE = 0.7


def faulty(device: Parameters, share: float) -> Parameters:
    """Return a device with a share of uneven levels, unmodulated light, planes out of focus, keystone, nonlinearity."""

    def camera(of: Camera, sign: int) -> Camera:
        return replace(of, keystone=(sign * 0.0015 * share, sign * 0.001 * share))

    device = out_of_focus(device, share)
    return replace(
        device,
        stroke_error=-0.015 * share,
        level_sine_rad=0.15 * share,
        unmodulated=0.1 * share,
        nonlinearity=0.03 * share,
        in_phase_camera=camera(device.in_phase_camera, 1),
        quadrature_camera=camera(device.quadrature_camera, -1),
    )


def out_of_focus(device: Parameters, share: float) -> Parameters:
    """Return a device with a share of 1.2 rad at the modulator, 0.8 and -0.7 rad at the cameras."""
    mm = MM_PER_RAD * share
    return replace(
        device,
        modulator_behind_mm=1.2 * mm,
        in_phase_camera=replace(device.in_phase_camera, behind_mm=0.8 * mm),
        quadrature_camera=replace(device.quadrature_camera, behind_mm=-0.7 * mm),
    )


DEVICES = {
    "usual": USUAL,
    "planes": out_of_focus(USUAL, 1.0),
    "third": faulty(USUAL, 1 / 3),
    "all": faulty(USUAL, 1.0),
}
"""Devices by name: without a fault, with planes out of focus alone, with a third of all faults, and with all."""


@click.command()
@click.option("--device", "name", type=click.Choice(list(DEVICES)), default="third", show_default=True)
@click.option("--drawn", type=click.IntRange(0), help="A device of the whole capture range, drawn by this seed.")
@click.option("--pages", default=30, show_default=True, type=click.IntRange(1))
@click.option("--seed", default=5, show_default=True, type=click.IntRange(0), help="Seed of symbols, noise and drift.")
@click.option("--out", type=OutputFile(), required=True, help="Recording, overwritten.")
def main(name: str, drawn: int | None, pages: int, seed: int, out: Path) -> None:
    """Record pages of an imperfect device, and print the truth."""
    device = DEVICES[name]
    if drawn is not None:
        device = faulty(draw_parameters(np.random.default_rng([drawn, 1])), DRAWN_SHARE)
    ForeignDevice(device).write(out, pages, LEVELS, seed)
    for key, value in asdict(device).items():
        click.echo(f"{key:<24} {value}")


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.comparison.foreign_recording"))
