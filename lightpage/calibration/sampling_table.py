"""The sampling table: what a decoder must know of the geometry, symbol by symbol, made by tracing a twin.

Per branch and symbol it holds the place and phase of the symbol's centre and their Taylor coefficients, so that a
decoder rebuilds both at every sample of the symbol: places are linear in the offset, phases quadratic to 1e-3 rad.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.interfaces import Twin
from lightpage.calibration.parameters import as_dict, as_vector
from lightpage.calibration.waves.wave_model import axial_of_cameras, defocus, fitted_geometry, tilts_of_cameras_apart
from lightpage.device.profile import Profile
from lightpage.waves.defocus import defocus_taps
from lightpage.waves.grid import field_grid

Real = NDArray[np.float64]
SamplingTable = dict[str, NDArray[Any]]
"""Tensors by their names as inputs of an exported decoder, float32 where `sampling_table` makes them."""

APART = ("apart", "apart_beside", "apart_tilt")
"""Names of what tells a decoder that cameras do not see the same plane, see `cameras_apart`."""
_FIT_POINTS = 9
_LEAST_APART_RAD = 0.06
"""Half of the difference of the cameras' defocus, as a phase at the facet's wall and root mean square over the page,
from which on it is dealt with. A decoder loses 0.08 bit at 0.04 radian where it is not, and four times that at twice as
much. It loses 0.2 bit where it was trained without, and takes longer."""
_LEAST_VARYING_RAD = 0.03
"""Root mean square of what tilts change of that over the page, from which on the change is dealt with as well."""
_LEAST_SPAN_RAD = 0.03
"""Least change from the middle of the page to where it is largest, for kernels that differ."""
_PLACE_BITS = 14
"""Fractional bits of places and gradients, grid samples. A float32 of thousands of samples has 12."""
_PHASE_BITS = 16
"""Fractional bits of phases, radians, which are followed to 1e-3. Random digits behind them would be most of what a
compressed table weighs."""


def monomial_powers() -> list[tuple[int, int]]:
    """Powers (of x, of y) of a cubic's ten terms, the order of `registration`'s last axis."""
    return [(i, j) for j in range(4) for i in range(4 - j)]


def symbol_centres(profile: Profile) -> Real:
    """Centres of all symbols as (x, y), [ny * nx, 2], metres from the page's centre, row by row."""
    rows, columns = profile.page_shape
    x = (np.arange(columns) - (columns - 1) / 2) * profile.symbol_pitch_m
    y = (np.arange(rows) - (rows - 1) / 2) * profile.symbol_pitch_m
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def registration_coefficients(twin: Twin, parameters: Real, profile: Profile) -> NDArray[np.float32]:
    """Pixels of both cameras as cubics in the grid's coordinates over the page's corner radius, [2, 2, 10]."""
    return registration_cubics(twin, parameters, profile).astype(np.float32)


def registration_cubics(twin: Twin, parameters: Real, profile: Profile) -> Real:
    """Return the coefficients of `registration_coefficients` in double precision, whose differences are derivatives."""
    grid = field_grid(profile)
    x, y = np.linspace(grid.x_m[0], grid.x_m[-1], _FIT_POINTS), np.linspace(grid.y_m[0], grid.y_m[-1], _FIT_POINTS)
    places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    terms = cubic_terms(places, profile)
    pixels = twin.pixels(parameters, places)
    return np.stack([np.linalg.lstsq(terms, camera, rcond=None)[0].T for camera in pixels])


def cubic_terms(places: Real, profile: Profile) -> Real:
    """Terms [N, 10] of a cubic at places (x, y) on the camera plane, metres [N, 2]."""
    u, v = places.T / profile.corner_m
    return np.stack([u**i * v**j for i, j in monomial_powers()], axis=-1)


def apart_inputs(parameters: Real) -> tuple[str, ...]:
    """Names of what a decoder must know of `cameras_apart`: none where both cameras see the same plane."""
    value = as_dict(parameters)
    middle, tilts = axial_of_cameras(value)[1], tilts_of_cameras_apart(value)
    varying = float(np.hypot(*tilts)) / np.sqrt(3)
    if np.hypot(middle, varying) < _LEAST_APART_RAD:
        return ()
    return APART if varying >= _LEAST_VARYING_RAD else APART[:1]


def cameras_apart(parameters: Real, profile: Profile) -> dict[str, NDArray[np.float32]]:
    """Defocus of the in-phase camera beyond the mean of both, by the names in `APART`.

    Returns:
        apart [2, taps], the kernel along either axis of the grid in the page's middle; apart_beside [2, 2, taps], the
        kernels where tilts of the cameras make it least and most; apart_tilt [2], slopes of the place between
        these, -1 to 1, along x and y over the page's corner radius.
    """
    value = as_dict(parameters)
    geometry, pitch = fitted_geometry(profile, value), field_grid(profile).pitch_m
    middle, tilts = axial_of_cameras(value)[1], np.array(tilts_of_cameras_apart(value))
    most = max(float(np.abs(tilts).sum()), _LEAST_SPAN_RAD)
    edges = np.array([profile.page_width_m, profile.page_height_m]) / 2
    at = defocus(np.array([middle, middle - most, middle + most]), geometry.pipe_width_m)
    kernels = [defocus_taps(geometry, float(each), pitch) for each in at]
    slopes = tilts / most * profile.corner_m / edges
    return dict(zip(APART, (kernels[0], np.stack(kernels[1:]), slopes.astype(np.float32)), strict=True))


def needed_apart(parameters: Real, profile: Profile) -> dict[str, NDArray[np.float32]]:
    """Return those of `cameras_apart` that `apart_inputs` names."""
    apart = cameras_apart(parameters, profile)
    return {name: apart[name] for name in apart_inputs(parameters)}


def orientations(linear: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return how cameras flip and swap the axes from (x, y) to (column, row), without small turns and scales.

    Args:
        linear: linear part of the cameras' maps, in any unit, [..., 2, 2].

    Returns:
        Zeros, and in each row and column one of 1 and -1, [..., 2, 2].
    """
    return np.asarray(np.rint(linear / np.abs(linear).max(axis=(-2, -1), keepdims=True)))


def shifted(registration: NDArray[np.float32], shift_px: Real) -> NDArray[np.float32]:
    """The registration [2, 2, 10] of an image that lies (x, y) camera pixels from where calibration saw it.

    The shift is that of the image in the camera plane: a camera that is mirrored or turned sees it so.
    """
    moved = registration.copy()
    shift = registration_orientations(registration) @ shift_px
    moved[..., monomial_powers().index((0, 0))] += np.asarray(shift, dtype=np.float32)
    return moved


def registration_orientations(registration: NDArray[np.float32]) -> NDArray[np.floating]:
    """Return the `orientations` of both cameras by their registration [2, 2, 10], [2, 2, 2]."""
    powers = monomial_powers()
    return orientations(registration[..., [powers.index((1, 0)), powers.index((0, 1))]])


def moved_cameras(parameters: Real, shift_px: Real) -> Real:
    """A device's parameters [P] with both cameras where they see the image `shifted`."""
    moved = as_dict(parameters)
    for camera in ("in_phase", "quadrature"):
        rows = ("scale_x_relative", "turn_xy_slope"), ("turn_yx_slope", "scale_y_relative")
        linear = np.eye(2) + [[moved[f"{camera}_{name}"] for name in row] for row in rows]
        for axis, by in zip("xy", orientations(linear) @ shift_px, strict=True):
            moved[f"{camera}_shift_{axis}_px"] += float(by)
    return as_vector(moved)


def sampling_table(twin: Twin, parameters: Real, quadrature_phase: float, profile: Profile) -> SamplingTable:
    """Trace the whole page.

    Args:
        twin: ray tracer of the device.
        parameters: [P] fitted parameters.
        quadrature_phase: angle between the homodyne arms, radians (90 degrees plus error, negative when Q is inverted).
        profile: the nominal device.

    Returns:
        registration [2, 2, 10]; homodyne [2] (cosine and sine of the turn); those of `cameras_apart`; parameters [P]
        themselves; with one symbol pitch as the unit of offset: places [B, 2, ny, nx] in grid samples (column, row),
        place_gradients [B, 4, ny, nx] as (dx/dx, dx/dy, dy/dx, dy/dy), phases [B, 6, ny, nx] as (value, d/dx, d/dy,
        d2/dx2, d2/dxdy, d2/dy2), the value within +-pi; positions [2, ny, nx], exit centroid over the pipe's width.
    """
    grid = field_grid(profile)
    rows, columns = profile.page_shape
    centres = symbol_centres(profile)
    step = profile.symbol_pitch_m / 2
    offsets = {(i, j): np.array([i, j]) * step for i in (-1, 0, 1) for j in (-1, 0, 1)}
    places, phases = {}, {}
    positions = np.empty(0)
    for key, offset in offsets.items():
        rays = twin.trace(parameters, centres + offset, centres)
        places[key], phases[key] = rays.places, rays.phases
        if key == (0, 0):
            positions = rays.positions
    origin = np.array([grid.x_m[0], grid.y_m[0]])
    middle = (places[0, 0] - origin) / grid.pitch_m
    along_x = (places[1, 0] - places[-1, 0]) / grid.pitch_m
    along_y = (places[0, 1] - places[0, -1]) / grid.pitch_m
    value = phases[0, 0]
    taylor = [
        np.angle(np.exp(1j * value)),
        phases[1, 0] - phases[-1, 0],
        phases[0, 1] - phases[0, -1],
        4 * (phases[1, 0] - 2 * value + phases[-1, 0]),
        phases[1, 1] - phases[1, -1] - phases[-1, 1] + phases[-1, -1],
        4 * (phases[0, 1] - 2 * value + phases[0, -1]),
    ]

    def as_maps(stack: Real, bits: int) -> NDArray[np.float32]:
        """[B, N, C] to [B, C, ny, nx], with so many binary places."""
        return _rounded(np.moveaxis(stack, -1, 1).reshape(len(stack), -1, rows, columns), bits)

    gradients = np.stack([along_x[..., 0], along_y[..., 0], along_x[..., 1], along_y[..., 1]], axis=-1)
    return {
        "registration": registration_coefficients(twin, parameters, profile),
        "homodyne": np.array([np.cos(quadrature_phase), np.sin(quadrature_phase)], dtype=np.float32),
        **cameras_apart(parameters, profile),
        "parameters": parameters.astype(np.float32),
        "places": as_maps(middle, _PLACE_BITS),
        "place_gradients": as_maps(gradients, _PLACE_BITS),
        "phases": as_maps(np.stack(taylor, axis=-1), _PHASE_BITS),
        "positions": np.ascontiguousarray(positions.T.reshape(2, rows, columns), dtype=np.float32),
    }


def _rounded(values: Real, bits: int) -> NDArray[np.float32]:
    return np.asarray(np.rint(values * 2.0**bits) / 2.0**bits, dtype=np.float32)
