"""Local measurements: how far, with what phase and slope, a patch of known symbols lies from where a twin puts it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.interfaces import BRANCHES, Twin
from lightpage.device.profile import Profile

Real = NDArray[np.float64]
Complex = NDArray[np.complexfloating]
Sampler = Callable[[Real], NDArray[np.inexact]]
"""Camera-plane points [..., 2] (metres) to the measured signal there, real or complex."""

_EDGE_SYMBOLS, _EDGE_PX = 10, 40
"""Edge of a patch: symbols enough to know them from others, and modulator pixels enough to be seen in dim light."""
SLOPES = np.linspace(-24, 24, 17)
"""Residual phase slopes tried, radians across a patch: page centre and lengths anywhere in the capture range."""
_CARRIER_PROBE = 0.3
"""Reach of the finite difference that finds the carrier, samples."""

_MIDDLE_X, _MIDDLE_Y = 0.16, 0.2
"""The page's middle, where most of the light takes the direct way: half its extents over the page's."""
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Patch:
    """A rectangle of symbols.

    Attributes:
        rows, columns: slices of the page.
        centre_m: (x, y) against the page's centre.
    """

    rows: slice
    columns: slice
    centre_m: tuple[float, float]


@dataclass(frozen=True)
class Measurement:
    """Measurement of one branch on one patch.

    Attributes:
        branch: name.
        centre_m: the patch's centre (x, y) on the page, [2].
        pixels: position of the centre, (column, row) on each camera, [2, 2].
        cameras: numbers of the cameras that were used.
        read_at: (column, row) on each camera where the twin had put the centre, [2, 2].
        phase: phase of the light against the symbols', radians, read there.
        carrier: how that phase changes with the pixels where it is read, radians a pixel along (column, row) on each
            camera, [2, 2]; half of the change belongs to either.
        slope: gradient of that phase along the page's (x, y), rad/m, [2].
        significance: power of the coherent sum over that of the symbols' incoherent sum; the number of symbols when
            all agree, about 1 when they are unrelated.
        symbols: number of symbols in the patch.
    """

    branch: str
    centre_m: Real
    pixels: Real
    cameras: tuple[int, ...]
    read_at: Real
    phase: float
    carrier: Real
    slope: Real
    significance: float
    symbols: int


def patch_edge(profile: Profile) -> int:
    """Return the approximate width and height of a patch, symbols."""
    return max(_EDGE_SYMBOLS, round(_EDGE_PX / profile.page.symbol_size_px))


def patches(profile: Profile) -> list[Patch]:
    """Cut the page into patches of about `patch_edge` x `patch_edge` symbols that cover it."""
    edge = patch_edge(profile)
    rows, columns = profile.page_shape

    def cuts(count: int) -> list[tuple[int, int]]:
        bounds = np.linspace(0, count, max(1, round(count / edge)) + 1).round().astype(int)
        return list(zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True))

    pitch = profile.symbol_pitch_m
    return [
        Patch(slice(r0, r1), slice(c0, c1), ((c0 + c1 - columns) / 2 * pitch, (r0 + r1 - rows) / 2 * pitch))
        for r0, r1 in cuts(rows)
        for c0, c1 in cuts(columns)
    ]


def middle_patches(profile: Profile, all_patches: list[Patch], least: int) -> list[Patch]:
    """The patches in the middle third of the page, or as many around them, whole rings, as make `least`."""

    def distance(patch: Patch) -> float:
        """Distance from the page's centre; 1 on the middle's border."""
        x, y = patch.centre_m
        return max(abs(x) / (_MIDDLE_X * profile.page_width_m), abs(y) / (_MIDDLE_Y * profile.page_height_m))

    distances = [distance(patch) for patch in all_patches]
    border = max(1.0, sorted(distances)[min(least, len(distances)) - 1])
    return [patch for patch, far in zip(all_patches, distances, strict=True) if far <= border * (1 + _ROUNDING)]


def search_window(reach_m: float, step_m: float) -> Real:
    """Trial shifts [K, 2] on a square lattice of odd side that reaches at least `reach_m`."""
    side = int(np.ceil(reach_m / step_m))
    axis = np.arange(-side, side + 1) * step_m
    return np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)


def measure(
    sampler: Sampler,
    twin: Twin,
    parameters: Real,
    profile: Profile,
    patch: Patch,
    symbols: Complex,
    branches: tuple[str, ...],
    window: Real,
    samples: int,
    cameras: tuple[int, ...] = (0, 1),
) -> list[Measurement]:
    """Find each branch of a patch within a window around where the twin puts it.

    Args:
        sampler: the measured signal.
        twin: the ray tracer.
        parameters: [P] current parameters.
        profile: the nominal device.
        patch: symbols to measure.
        symbols: light that the modulator makes of the whole page's, complex [ny, nx].
        branches: branches to look for.
        window: trial shifts [K, 2], metres on the camera plane, a square lattice (see `search_window`).
        samples: samples per symbol along each axis; the field's own rate (`symbol_samples`), or half of it in a wide
            search.
        cameras: cameras that the sampler looks through, a label of the result.
    """
    known = symbols[patch.rows, patch.columns]
    rows, columns = known.shape
    pitch = profile.symbol_pitch_m / samples
    slopes = SLOPES / (patch_edge(profile) * samples)
    x = (np.arange(columns * samples) - (columns * samples - 1) / 2) * pitch + patch.centre_m[0]
    y = (np.arange(rows * samples) - (rows * samples - 1) / 2) * pitch + patch.centre_m[1]
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    centre = np.array(patch.centre_m)
    stencil = centre + pitch * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    rays = twin.trace(parameters, np.vstack([points, stencil]), np.tile(centre, (len(points) + len(stencil), 1)))
    template = np.conj(np.kron(known, np.ones((samples, samples)))).ravel()
    kernel_y = np.exp(-1j * np.outer(slopes, (y - centre[1]) / pitch)).astype(np.complex64)
    kernel_x = np.exp(-1j * np.outer((x - centre[0]) / pitch, slopes)).astype(np.complex64)
    found = []
    for branch in branches:
        b = BRANCHES.index(branch)
        expected = rays.phases[b, -len(stencil) :]
        expected_slope = np.array([expected[1] - expected[2], expected[3] - expected[4]]) / (2 * pitch)
        landing = rays.places[b, -len(stencil)]
        matched = (template * np.exp(-1j * rays.phases[b, : len(points)])).astype(np.complex64)

        places = rays.places[b, : len(points)]

        def demodulated(shifts: Real, at: Real = places, by: Complex = matched) -> Complex:
            signal = sampler(at + shifts[:, None, :])
            return np.asarray(signal * by, dtype=np.complex64).reshape(len(shifts), len(y), len(x))

        trials = demodulated(window)
        spectrum = np.abs(kernel_y @ trials @ kernel_x) ** 2
        significance = spectrum / _incoherent(trials, rows, columns)[:, None, None]
        best, i, j = np.unravel_index(int(np.argmax(significance)), significance.shape)
        side = round(len(window) ** 0.5)
        by_shift = significance[:, i, j].reshape(side, side)
        row, column = divmod(int(best), side)
        step = float(window[1, 0] - window[0, 0]) if side > 1 else 0.0
        shift = window[best] + step * np.array([_peak(by_shift[row], column), _peak(by_shift[:, column], row)])
        slope_step = slopes[1] - slopes[0]
        slope_x = slopes[j] + slope_step * _peak(significance[best, i], int(j))
        slope_y = slopes[i] + slope_step * _peak(significance[best, :, j], int(i))
        # A beam that a wall has cut leaves through one side of the facet, so its phase runs across its image: read it
        # at the twin's place, together with how fast it runs, and let the fit carry it to the true place.
        probe = _CARRIER_PROBE * pitch * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
        ramp = np.exp(-1j * (slope_y * (y - centre[1])[:, None] + slope_x * (x - centre[0])[None, :]) / pitch)
        *around, there = demodulated(np.vstack([probe, shift])) * ramp
        read = np.array([np.sum(light) for light in around])
        across = np.angle([read[1] * np.conj(read[2]), read[3] * np.conj(read[4])])
        read_at, right, left, down, up, found_at = np.moveaxis(
            twin.pixels(parameters, landing + np.vstack([probe, shift])), 1, 0
        )
        # a camera may show the image turned or mirrored
        carrier = np.linalg.solve(np.stack([right - left, down - up], axis=1), across[:, None])[..., 0] / 2
        power = abs(np.sum(there)) ** 2
        floor = float(_incoherent(there[None], rows, columns)[0])
        found.append(
            Measurement(
                branch=branch,
                centre_m=centre,
                pixels=found_at,
                cameras=cameras,
                read_at=read_at,
                phase=float(expected[0] + np.angle(read[0])),
                carrier=carrier,
                slope=expected_slope + np.array([slope_x, slope_y]) / pitch,
                significance=float(power / floor),
                symbols=rows * columns,
            )
        )
    return found


def _incoherent(trials: Complex, rows: int, columns: int) -> Real:
    """Sum over symbols of the power of each symbol's own sum, [K]."""
    samples = trials.shape[1] // rows
    per_symbol = trials.reshape(len(trials), rows, samples, columns, samples).sum(axis=(2, 4))
    return np.asarray(np.maximum(np.sum(np.abs(per_symbol) ** 2, axis=(1, 2)), 1e-30))


def _peak(values: NDArray[np.floating], index: int) -> float:
    """Vertex of the parabola through the maximum and its neighbours, in steps from `index`; 0 at the edge."""
    if index in (0, len(values) - 1):
        return 0.0
    left, middle, right = (float(v) for v in values[index - 1 : index + 2])
    bend = left - 2 * middle + right
    return 0.0 if bend >= 0 else float(np.clip((left - right) / (2 * bend), -0.5, 0.5))
