"""The common grid on the camera plane on which both cameras' frames become one complex field, and its filters."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy
from numpy.typing import NDArray

from lightpage.device.profile import Profile
from lightpage.errors import InvalidInputError, ProfileError
from lightpage.waves.resampling import CorrectedInterpolation, corrected_interpolation

Real = NDArray[np.float64]

GRID_STEP_PX = 2
"""Usual grid pitch in camera pixels: twice the Nyquist rate of the field, just above that of its intensity."""
_MARGIN_PX = 70
"""Grid beyond the nominal image of the page, camera pixels on each side: page shift and diffraction."""
_PREFILTER_TAPS = 11
_PREFILTER_STOP = 0.36
"""Cycles per pixel: so few taps stop nothing below it. On a grid of every third pixel some noise folds."""
_PASS_STEPS = 8
"""Straight pieces of the prefilter's gain in its pass band."""
_BAND_TAPS = 31
_BAND_HEADROOM = 1.06
"""Pass band over the pipe's nominal band, for misalignment of the pipe against the lens axes."""
_BAND_STOP = 1.36
"""Beginning of its stop band, over the same."""
_NYQUIST = 0.5
"""Cycles per sample."""

_FEWEST_STEPS = 32
_LARGEST_LAG = 22.0
"""Radians; see `splitting_steps`."""

_ROUNDING = 1e-9
_MOST_SAMPLES = 4


@dataclass(frozen=True)
class FieldGrid:
    """Axes and filters of the common grid.

    Attributes:
        x_m, y_m: uniform axes, metres from the optical axis, [nx] and [ny].
        step_px: pitch in camera pixels.
        edge: edge of the pipe's band, cycles per camera pixel.
    """

    x_m: Real
    y_m: Real
    step_px: int
    edge: float

    @cached_property
    def prefilter(self) -> Real:
        """Taps applied along each axis of a raw frame before it is resampled to the grid, linearly.

        They make good, on average over the places between two pixels, what that takes off high frequencies.
        """
        return _before_linear(_PREFILTER_TAPS, 2 * self.edge, max(1 / self.step_px - self.edge, _PREFILTER_STOP))

    @cached_property
    def band(self) -> Real:
        """Taps applied along each axis of the field on the grid: the pipe's band."""
        edge = self.edge * self.step_px
        return _low_pass(_BAND_TAPS, _BAND_HEADROOM * edge, _BAND_STOP * edge)

    @cached_property
    def resampling(self) -> CorrectedInterpolation:
        """Filters around a linear interpolation of raw frames that is corrected for its places between pixels."""
        return corrected_interpolation(self.edge, self.step_px)

    @property
    def shape(self) -> tuple[int, int]:
        """(ny, nx)."""
        return len(self.y_m), len(self.x_m)

    @property
    def pitch_m(self) -> float:
        """Sample spacing."""
        return float(self.x_m[1] - self.x_m[0])


def check_camera(profile: Profile) -> None:
    """Check that the cameras see all of the page's image, and the pipe's light finely enough.

    All is compared where the image has the page's own size (`Profile.image_pixel_m`). The intensity of light from a
    pipe of width w has frequencies up to w / (lambda f), twice the field's; two samples a period on a grid of
    `GRID_STEP_PX` pixels need pixels of at most lambda f / (2 GRID_STEP_PX w).

    Raises:
        ProfileError: the camera's pixels are too coarse or too few; the message says what would do.
    """
    camera, subject = profile.camera, f"profile {profile.name}: camera"
    pixel, magnification = profile.image_pixel_m, profile.camera_magnification
    coarsest = profile.light.wavelength_m * profile.lens.focal_length_m / (2 * GRID_STEP_PX * profile.pipe.width_m)
    if pixel > coarsest * (1 + _ROUNDING):
        least = profile.relay.magnification * pixel / coarsest
        raise ProfileError(
            f"{subject}.pitch_m",
            f"{camera.pitch_m:.4g} m",
            f"at most {coarsest * magnification:.4g} m, to resolve the pipe's light, or a relay.magnification of at "
            f"least {least:.4g}",
        )
    for key, count, extent in (
        ("columns_px", camera.columns_px, profile.page_width_m),
        ("rows_px", camera.rows_px, profile.page_height_m),
    ):
        least = int(np.ceil(extent / pixel * (1 - _ROUNDING)))
        if count < least:
            most = profile.relay.magnification * count * pixel / extent
            told = f"to see the page's image of {extent * magnification * 1e3:.4g} mm"
            expected = f"at least {least}, {told}, or a relay.magnification of at most {most:.4g}"
            raise ProfileError(f"{subject}.{key}", count, expected)


def field_grid(profile: Profile, step_px: int = GRID_STEP_PX) -> FieldGrid:
    """The grid for a device: covers the nominal page image and a margin.

    Args:
        profile: the device.
        step_px: pitch in camera pixels, where a coarser grid than the usual one will do.

    Raises:
        ProfileError: the camera is too coarse or too small (`check_camera`).
        InvalidInputError: a pitch finer than the usual one, or too coarse for the pipe's band.
    """
    check_camera(profile)
    pixel = profile.image_pixel_m
    pitch = step_px * pixel

    def axis(extent_m: float) -> Real:
        count = int(np.ceil((extent_m + 2 * _MARGIN_PX * pixel) / pitch / 2)) * 2
        return np.asarray((np.arange(count) - (count - 1) / 2) * pitch)

    edge = profile.pipe.width_m / 2 / (profile.light.wavelength_m * profile.lens.focal_length_m) * pixel
    coarsest = int(_NYQUIST / (_BAND_STOP * edge))
    if not GRID_STEP_PX <= step_px <= coarsest:
        expected = f"{GRID_STEP_PX} to {coarsest}"
        raise InvalidInputError("pitch of the common grid, camera pixels", step_px, expected)
    return FieldGrid(axis(profile.page_width_m), axis(profile.page_height_m), step_px, edge)


def symbol_samples(profile: Profile) -> int:
    """Samples per symbol and axis that light is looked at with: the field's own rate, one a modulator pixel, at most 4.

    The pipe passes 0.77 times as many waves an axis as the page's image has modulator pixels; larger symbols keep most
    of their light where four samples see it.
    """
    return min(_MOST_SAMPLES, profile.page.symbol_size_px)


def splitting_steps(profile: Profile, share: float = 1.0) -> int:
    """Steps in which light goes through a sheared pipe (`lightpage.waves.channel.PipePropagator`).

    In each the light of the page's corner falls behind that along the axis by at most `_LARGEST_LAG`, so a pipe that is
    longer takes more. The error grows with the shear: of the bench device's field 0.002 at 0.6 degree, with 32 steps,
    and 0.05 at 5 degrees.

    Args:
        profile: the device.
        share: share of the steps that are taken, where less accuracy will do.
    """
    pipe, lens = profile.pipe, profile.lens
    steepness = profile.corner_m / lens.focal_length_m
    lag = np.pi * steepness**2 * pipe.length_m / (profile.light.wavelength_m * pipe.refractive_index)
    return int(np.ceil(share * max(_FEWEST_STEPS, np.ceil(lag / _LARGEST_LAG))))


def _low_pass(taps: int, passed: float, stopped: float) -> Real:
    """Equiripple low-pass with unit gain at zero; band edges in cycles per sample."""
    kernel = scipy.signal.remez(taps, [0, passed, stopped, 0.5], [1, 0], weight=[3, 1], fs=1.0)
    return np.asarray(kernel / kernel.sum())


def _before_linear(taps: int, passed: float, stopped: float) -> Real:
    """Least-squares low-pass with the inverse of linear interpolation's mean gain, sinc^2, in its pass band."""
    steps = np.linspace(0, passed, _PASS_STEPS + 1)
    bands = [*np.repeat(steps, 2)[1:-1], stopped, 0.5]
    gains = [*(1 / np.sinc(bands[:-2]) ** 2), 0, 0]
    kernel = scipy.signal.firls(taps, bands, gains, weight=[1] * _PASS_STEPS + [1.3], fs=1.0)
    return np.asarray(kernel / kernel.sum())
