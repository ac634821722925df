"""Consequences of a profile: the image on the cameras, its light in the pipe, what a page takes."""

from __future__ import annotations

import math
from dataclasses import dataclass

from lightpage.device.profile import Profile
from lightpage.errors import ProfileError
from lightpage.page.levels import MAX_LEVELS
from lightpage.waves.geometry import WaveGeometry, modes_for
from lightpage.waves.grid import check_camera

_FEW_PIXELS = 8.0
"""Camera pixels a symbol: the shipped devices have 15; fewer were never tried."""
_DECODERS = {
    "fast": ((4_872, 0.0253), (78_750, 0.425), 1.04e9),
    "standard": ((4_872, 0.0905), (78_750, 2.343), 2.34e9),
    "accurate": ((4_872, 0.132), (78_750, 3.410), 3.59e9),
}
"""Costs by preset: symbols and seconds a page of either shipped device on two cores, and bytes at the larger one's
peak (docs/results/full-size.md)."""
_BASE_BYTES = 0.25e9
"""Memory of a process that holds a bundle and no page yet."""


@dataclass(frozen=True)
class Cost:
    """Cost of a page on two cores, about.

    Attributes:
        seconds: time to decode it.
        memory_gb: memory at the peak.
    """

    seconds: float
    memory_gb: float


@dataclass(frozen=True)
class Consequences:
    """Consequences of a profile.

    Attributes:
        symbols: number of symbols of a page.
        most_bits: bits that they can carry, 256 levels each.
        pixels_per_symbol: camera pixels along a symbol's edge.
        image_px: width and height of the page's image on a camera, pixels.
        magnification: magnification of the page's image on the sensors.
        aperture: numerical aperture of the page's corner, small angles.
        walls_met: most walls that light meets along x and along y.
        modes: sine modes of the pipe along x and along y that carry the page's light.
        carried: share of a symbol's first diffraction order that the pipe's width passes; below 1 symbols blur.
        pair_mb: megabytes of a frame pair, 8 bits a count.
        cost: cost of a page, by preset of `lightpage train`.
        refused: why such a device cannot be read; empty where it can.
        doubts: what was never tried, or will cost information.
    """

    symbols: int
    most_bits: int
    pixels_per_symbol: float
    image_px: tuple[int, int]
    magnification: float
    aperture: float
    walls_met: tuple[int, int]
    modes: tuple[int, int]
    carried: float
    pair_mb: float
    cost: dict[str, Cost]
    refused: tuple[str, ...]
    doubts: tuple[str, ...]


def consequences(profile: Profile) -> Consequences:
    """Return what follows from a profile."""
    rows, columns = profile.page_shape
    halves = profile.page_width_m / 2, profile.page_height_m / 2
    pixel, pipe = profile.image_pixel_m, profile.pipe
    steps = [half / profile.lens.focal_length_m * pipe.length_m / pipe.refractive_index for half in halves]
    order_m = profile.light.wavelength_m * profile.lens.focal_length_m / profile.symbol_pitch_m
    geometry = WaveGeometry(
        wavelength_m=profile.light.wavelength_m,
        focal_length_m=profile.lens.focal_length_m,
        pipe_length_m=pipe.length_m,
        pipe_width_m=pipe.width_m,
        refractive_index=pipe.refractive_index,
    )
    return Consequences(
        symbols=rows * columns,
        most_bits=round(rows * columns * math.log2(MAX_LEVELS)),
        pixels_per_symbol=profile.symbol_pitch_m / pixel,
        image_px=(round(profile.page_width_m / pixel), round(profile.page_height_m / pixel)),
        magnification=profile.camera_magnification,
        aperture=profile.corner_m / profile.lens.focal_length_m,
        walls_met=(_walls(steps[0], pipe.width_m), _walls(steps[1], pipe.width_m)),
        modes=(modes_for(halves[0], geometry, 1.0), modes_for(halves[1], geometry, 1.0)),
        carried=pipe.width_m / order_m,
        pair_mb=2 * profile.camera.rows_px * profile.camera.columns_px / 1e6,
        cost={preset: _cost(preset, rows * columns) for preset in _DECODERS},
        refused=_refused(profile),
        doubts=tuple(_doubts(profile, order_m, steps)),
    )


def _walls(step_m: float, width_m: float) -> int:
    """Return the number of walls that a ray from the facet's middle meets if it shifts by `step_m`."""
    return math.floor(step_m / width_m + 0.5)


def _cost(preset: str, symbols: int) -> Cost:
    """Return the cost by the power law through both shipped devices."""
    (few, short), (many, long), peak = _DECODERS[preset]
    power = math.log(long / short) / math.log(many / few)
    memory = _BASE_BYTES + (peak - _BASE_BYTES) * symbols / many
    return Cost(short * (symbols / few) ** power, memory / 1e9)


def _refused(profile: Profile) -> tuple[str, ...]:
    try:
        check_camera(profile)
    except ProfileError as error:
        return (str(error),)
    return ()


def _doubts(profile: Profile, order_m: float, steps: list[float]) -> list[str]:
    pipe, told = profile.pipe, []
    if order_m > pipe.width_m * (1 + 1e-9):
        least = math.ceil(profile.page.symbol_size_px * order_m / pipe.width_m)
        told.append(
            f"the pipe is {pipe.width_m * 1e3:.4g} mm wide, and symbols of {profile.page.symbol_size_px} pixels need "
            f"{order_m * 1e3:.4g} mm: page.symbol_size_px from {least}, or a shorter lens.focal_length_m"
        )
    if (own := profile.symbol_pitch_m / profile.image_pixel_m) < _FEW_PIXELS:
        told.append(
            f"{own:.3g} camera pixels a symbol, never tried below {_FEW_PIXELS:g}: "
            f"relay.magnification {profile.relay.magnification * _FEW_PIXELS / own:.3g}, or a smaller camera.pitch_m"
        )
    for axis, size, step in zip("xy", ("columns", "rows"), steps, strict=True):
        if _walls(step, pipe.width_m) == 0:
            told.append(
                f"no light meets a wall along {axis}, and calibration needs some that does along both axes: more "
                f"page.{size}, or pipe.length_m from {pipe.length_m * pipe.width_m / 2 / step:.4g}"
            )
    return told
