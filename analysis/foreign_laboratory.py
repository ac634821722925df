"""Hand over pages as another laboratory would: pictures of its cameras, a log with gaps, and notes that omit something.

    python -m analysis.foreign_laboratory --seed 1 --out LAB --truth T.npy
    lightpage import --profile bench --in-phase LAB/monday/camera_a --quadrature LAB/monday/camera_b \\
        --reference-in-phase LAB/references/camera_a --reference-quadrature LAB/references/camera_b \\
        --symbols LAB/monday/log.npy --out monday.h5
    lightpage calibrate --recording monday.h5 --out C.toml --export B.zip

The device is one of the whole capture range, with a share of every fault of `ForeignDevice.with_faults`. Every picture
is a TIFF file. One camera's pictures are mirrored left to right: its frames need `--flip-in-phase x` or
`--flip-quadrature x`. The notes do not say which, nor how far the phase of the signal drifts. The log lacks Tuesday's
pages, whose symbols go to --truth. The true parameters are printed.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

import click
import h5py
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from analysis.foreign_device import CAMERA_PITCH, REFERENCE_EXPOSURES, SLM_PITCH, SYMBOL_PX, WAVELENGTH, ForeignDevice
from lightpage.cli.main import run
from lightpage.cli.paths import NewPath, OutputFile
from lightpage.failures import os_errors

LEVELS = 256
UNLOGGED_SHARE = 2 / 7
CAMERAS = {"camera_a": "in_phase", "camera_b": "quadrature"}
"""Names of the cameras in the folders, and in a recording."""
_NOTES = """\
Light of {wavelength_nm:.0f} nm. Modulator: pixels of {slm_um:.1f} um, pages of {rows} x {columns} symbols of \
{symbol_px} x {symbol_px} pixels, {levels} levels.
Lenses of {focal_mm:.1f} mm. Pipe of fused silica, {length_mm:.2f} mm long, {width_mm:.5f} mm wide.
camera_a is the in-phase camera, camera_b the quadrature camera: pixels of {camera_um:.1f} um, {bits} bits.
There is one mirror more before one of the cameras.
references: the reference beam alone, mean of {exposures} exposures, before the first page.
monday: {logged} pages. log.npy has their symbols [page, row, column].
tuesday: {unlogged} pages. They were not logged.
"""


@dataclass(frozen=True)
class Withheld:
    """Facts that a laboratory does not hand over.

    Attributes:
        mirrored: name of the camera whose pictures are mirrored.
        symbols: symbols of the pages that the log lacks, [page, ny, nx].
    """

    mirrored: str
    symbols: NDArray[np.uint8]


def hand_over(device: ForeignDevice, pages: int, seed: int, folder: Path) -> Withheld:
    """Write all that a laboratory hands over.

    Args:
        device: device of the laboratory.
        pages: number of pages, two or more.
        seed: seed of symbols, noise and drift, and of which camera is mirrored.
        folder: folder that is made.
    """
    logged = pages - max(1, round(UNLOGGED_SHARE * pages))
    mirrored = list(CAMERAS)[np.random.default_rng([seed, 3]).integers(len(CAMERAS))]
    days = {"monday": range(logged), "tuesday": range(logged, pages)}
    with tempfile.TemporaryDirectory() as made:
        recording = Path(made) / "pages.h5"
        symbols = device.write(recording, pages, LEVELS, seed)
        with h5py.File(str(recording)) as file:
            for camera, name in CAMERAS.items():
                mirror = camera == mirrored
                _save(folder / "references" / camera, [file[f"reference_{name}"][()]], mirror)
                for day, numbers in days.items():
                    _save(folder / day / camera, (file[name][page] for page in numbers), mirror)
    np.save(folder / "monday" / "log.npy", symbols[:logged])
    (folder / "notes.txt").write_text(_notes(device, logged, pages), "utf-8")
    return Withheld(mirrored, symbols[logged:])


def _save(folder: Path, frames: Iterable[NDArray[np.unsignedinteger]], mirror: bool) -> None:
    folder.mkdir(parents=True)
    for number, frame in enumerate(frames, 1):
        Image.fromarray(np.ascontiguousarray(frame[:, ::-1] if mirror else frame)).save(folder / f"{number:04d}.tif")


def _notes(device: ForeignDevice, logged: int, pages: int) -> str:
    design = device.design
    rows, columns = design.page_shape
    return _NOTES.format(
        wavelength_nm=WAVELENGTH * 1e6,
        slm_um=SLM_PITCH * 1e3,
        rows=rows,
        columns=columns,
        symbol_px=SYMBOL_PX,
        levels=LEVELS,
        focal_mm=design.focal_length,
        length_mm=design.pipe_length,
        width_mm=design.pipe_width,
        camera_um=CAMERA_PITCH * 1e3,
        bits=device.parameters.bit_depth,
        exposures=REFERENCE_EXPOSURES,
        logged=logged,
        unlogged=pages - logged,
    )


@click.command()
@click.option("--pages", default=14, show_default=True, type=click.IntRange(2))
@click.option(
    "--faults",
    default=0.33,
    show_default=True,
    type=click.FloatRange(0, 3),
    help="Share of the usual size of every fault.",
)
@click.option(
    "--seed", default=1, show_default=True, type=click.IntRange(0), help="Seed of the device and of its pages."
)
@click.option("--truth", type=OutputFile(), help="Symbols of the pages that the log lacks, .npy.")
@click.option("--out", type=NewPath(), required=True, help="Folder of the laboratory, made by this command.")
def main(pages: int, faults: float, seed: int, truth: Path | None, out: Path) -> None:
    """Hand over pages as another laboratory would, and print the truth."""
    device = ForeignDevice.draw(seed).with_faults(faults).with_parameters(blemish_seed=seed)
    with os_errors(f"--out {out}", "a folder that can be made"):
        withheld = hand_over(device, pages, seed, out)
    if truth is not None:
        with os_errors(f"--truth {truth}", "a file that can be written"), truth.open("wb") as file:
            np.save(file, withheld.symbols)
    for key, value in {**asdict(device.parameters), "mirrored": withheld.mirrored}.items():
        click.echo(f"{key:<24} {value}")


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.foreign_laboratory"))
