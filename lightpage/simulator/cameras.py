"""Camera frames of a field and a reference beam: interference, pose of each camera, exposure, counts."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from lightpage.device.profile import Camera
from lightpage.device.state import CameraPose, Sensor
from lightpage.simulator.engine import NUMPY, Engine

Real = NDArray[np.floating]
Complex = NDArray[np.complexfloating]

_SPECK_PX = 2.0, 6.0
"""Radii of the specks' shadows, standard deviations of a Gaussian."""
_SPECK_DEPTH = 0.3, 0.9
"""Shares of the light that they take off in the middle."""


def in_phase_intensity(field: Complex, reference: Complex, contrast: float = 1.0) -> Real:
    """|E + R|^2: the s-polarised port of the homodyne detector (supplement S12, eq. 3-4, up to its constant).

    Args:
        field: signal E, any shape.
        reference: reference R, same shape.
        contrast: factor of the interference term.
    """
    intensity: Real = abs(field + reference) ** 2
    if contrast != 1:
        intensity = contrast * intensity + (1 - contrast) * (abs(field) ** 2 + abs(reference) ** 2)
    return intensity


def quadrature_intensity(
    field: Complex, reference: Complex, error: float = 0.0, sign: int = 1, contrast: float = 1.0
) -> Real:
    """|E + i R|^2: the p-polarised port, where the quarter-wave plate has turned the signal against the reference.

    Args:
        field, reference, contrast: see `in_phase_intensity`.
        error: deviation of the turn from 90 degrees, radians.
        sign: -1 when the wave plate is mounted the other way and the turn is -90 degrees.
    """
    return in_phase_intensity(field, reference * (sign * 1j * np.exp(1j * error)), contrast)


@dataclass(frozen=True)
class CameraView:
    """View of one camera: the points of the common camera plane that its pixels see.

    Args:
        camera: sensor size, and pitch where the image has the page's own size.
        pose: similarity transform of the sensor.
        distortion_relative: relative radial displacement of the image at `distortion_radius_m`.
        distortion_radius_m: normalising radius.
        edges_m: half width and half height of the page's image, where the keystone is stated.
    """

    camera: Camera
    pose: CameraPose
    distortion_relative: float
    distortion_radius_m: float
    edges_m: tuple[float, float]

    def positions_m(self, engine: Engine = NUMPY) -> tuple[Real, Real]:
        """Points (x, y) of the camera plane that land on the pixels, two arrays [rows, columns], metres."""
        columns, rows = np.arange(self.camera.columns_px), np.arange(self.camera.rows_px)
        column = engine.exact(columns - (self.camera.columns_px - 1) / 2 - self.pose.shift_x_px)
        row = engine.exact(rows - (self.camera.rows_px - 1) / 2 - self.pose.shift_y_px)
        rotation = math.radians(self.pose.rotation_deg)
        per_px = self.camera.pitch_m / (1 + self.pose.scale_relative_error)
        x = per_px * (math.cos(rotation) * column[None, :] + math.sin(rotation) * row[:, None])
        y = per_px * (-math.sin(rotation) * column[None, :] + math.cos(rotation) * row[:, None])
        keystone = (
            self.pose.keystone_x_relative * x / self.edges_m[0] + self.pose.keystone_y_relative * y / self.edges_m[1]
        )
        shrink = 1 - self.distortion_relative * (x**2 + y**2) / self.distortion_radius_m**2 - keystone
        return x * shrink, y * shrink


@dataclass(frozen=True)
class Blemishes:
    """Blemishes of single pixels of one camera.

    Attributes:
        transmission: share of the light that dust lets through, float32 [rows, columns], or 1.
        late_transmission: the same of dust that settled after the references were recorded.
        hot: pixels that are always at full scale, [rows, columns]; none if there are no such.
        engine: what the arrays belong to.
    """

    transmission: Real | float = 1.0
    late_transmission: Real | float = 1.0
    hot: NDArray[np.bool_] | None = None
    engine: Engine = NUMPY

    @classmethod
    def of(cls, camera: Camera, sensor: Sensor, which: int, engine: Engine = NUMPY) -> Self:
        """Draw those of camera number `which`, always the same."""
        shape = camera.rows_px, camera.columns_px
        hot_rng, dust_rng, late_rng = (np.random.default_rng([sensor.blemish_seed, which, kind]) for kind in range(3))
        hot: NDArray[np.bool_] | None = None

        def transmission(specks: int, rng: np.random.Generator) -> Real | float:
            return engine.array(_behind_dust(shape, rng.random((specks, 4)))) if specks else 1.0

        if sensor.hot_pixel_share:
            hot = engine.array(hot_rng.random(shape, dtype=np.float32) < sensor.hot_pixel_share)
        dust = transmission(sensor.dust_specks, dust_rng)
        return cls(dust, transmission(sensor.late_dust_specks, late_rng), hot, engine)

    def counted(self, counts: Any, sensor: Sensor) -> Any:
        """Counts with those of hot pixels, in the type of the frames."""
        if self.hot is not None:
            counts = self.engine.xp.where(self.hot, 2.0**sensor.bit_depth - 1, counts)
        return self.engine.counts(counts, sensor.bit_depth)


def _behind_dust(shape: tuple[int, int], drawn: Real) -> Real:
    """Share of the light that passes specks, float32 [rows, columns].

    Args:
        shape: (rows, columns).
        drawn: four numbers from 0 to 1 for each speck: row, column, radius and depth of its shadow, [n, 4].
    """
    passed = np.ones(shape, np.float32)
    for row, column, size, depth in drawn:
        radius = _SPECK_PX[0] + size * (_SPECK_PX[1] - _SPECK_PX[0])
        centre, reach = (row * shape[0], column * shape[1]), int(np.ceil(4 * radius))
        y, x = (np.arange(max(0, int(c) - reach), min(n, int(c) + reach)) for c, n in zip(centre, shape, strict=True))
        away2 = (y[:, None] - centre[0]) ** 2 + (x - centre[1]) ** 2
        darkest = _SPECK_DEPTH[0] + depth * (_SPECK_DEPTH[1] - _SPECK_DEPTH[0])
        passed[np.ix_(y, x)] *= 1 - darkest * np.exp(-away2 / (2 * radius**2))
    return passed


def resample(image: Real, x_m: Real, y_m: Real, at_x_m: Real, at_y_m: Real, engine: Engine = NUMPY) -> Real:
    """Cubic-spline values of `image`, sampled on the uniform axes (y_m, x_m), at scattered points, float32."""
    rows = (at_y_m - float(y_m[0])) / float(y_m[1] - y_m[0])
    columns = (at_x_m - float(x_m[0])) / float(x_m[1] - x_m[0])
    values: Real = engine.spline(image, rows, columns)
    return values


def expose(intensity: Real, electrons_per_unit: float, sensor: Sensor, noise: Any, engine: Engine = NUMPY) -> Real:
    """Shot noise, read noise, clipping at the full well and quantisation; counts of the sensor's bit depth.

    `noise` is a generator of the engine.
    """
    expected = engine.xp.clip(intensity * electrons_per_unit, 0, None)
    electrons = noise.poisson(expected) + sensor.read_noise_e * noise.standard_normal(intensity.shape, dtype=np.float32)
    return to_counts(electrons, sensor, engine)


def to_counts(electrons: Real, sensor: Sensor, engine: Engine = NUMPY) -> Real:
    """Electrons to counts, whole numbers: full scale is the full well."""
    if sensor.nonlinearity_relative:
        electrons = engine.xp.clip(electrons, None, sensor.full_well_e)
        electrons = electrons * (1 + sensor.nonlinearity_relative * electrons / sensor.full_well_e)
    top = 2**sensor.bit_depth - 1
    black = sensor.black_level_relative * top
    counts: Real = engine.xp.clip(engine.xp.round(electrons * (top / sensor.full_well_e) + black), 0, top)
    return counts
