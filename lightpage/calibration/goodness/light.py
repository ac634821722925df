"""The light of a known page as cameras saw it, and as fitted waves have it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.goodness.frame_noise import CountCurve, noise_like, on_pixels
from lightpage.calibration.interfaces import Twin
from lightpage.calibration.parameters import PARAMETERS, SEEN_BY_CAMERAS, STEPS
from lightpage.calibration.samplers import smooth_reference
from lightpage.calibration.waves.wave_fit import READ_NOISE
from lightpage.calibration.waves.wave_model import FittedWaves, LaunchConditions, illumination_terms, on_modulator
from lightpage.recording.frame_pair import FramePair
from lightpage.waves.geometry import couplings, facet_axis, on_facet
from lightpage.waves.grid import field_grid, symbol_samples
from lightpage.waves.parallel import in_parallel

Real = NDArray[np.float64]
Complex = NDArray[np.complexfloating]

_EQUATIONS, _LEAST_STRIDE = 30_000, 4
"""Approximate limit of equations for each camera by which the model is corrected, and least number of the common grid's
samples from one to the next: few unknowns need few."""
_EVERYWHERE = (slice(None), slice(None))
_ACCURACY = 3 / 8
"""Share of the splitting steps for corrections."""
_LOSSES = (1, 2)
"""Powers of R^2 in the light that is lost towards the edges of the entrance facet."""


class SeenLight:
    """The light of a known page as cameras saw it, and as the fitted waves have it.

    Light of both cameras is [2, Gy, Gx], on the common grid.

    Attributes:
        waves: the fitted ones.
        page: light on the modulator, [ny samples, nx samples].
        steps: nominal phases of the samples beside each along x, and along y, less twice its own, [2, ny samples,
            nx samples].
        fields: light that the model predicts for each camera.
        counts: frames less references, over twice the references, [2, Gy, Gx].
        references: counts of the references, [2, Gy, Gx].
    """

    def __init__(
        self,
        twin: Twin,
        device: CalibratedDevice,
        conditions: LaunchConditions,
        pair: FramePair,
        symbols: NDArray[np.complex128],
    ) -> None:
        self._twin, self._device, self._pair, profile = twin, device, pair, device.profile
        self._samples, self._grid = symbol_samples(profile), field_grid(profile)
        self._stride = max(_LEAST_STRIDE, int(np.sqrt(np.prod(self._grid.shape) / _EQUATIONS)))
        self._every = (slice(None, None, self._stride), slice(None, None, self._stride))
        self._blur = conditions.blur
        self.waves = FittedWaves(profile, device.parameters, self._samples, filled=True, blur=self._blur)
        self._terms = np.stack(illumination_terms(self.waves.x, self.waves.y))
        illumination = np.tensordot(conditions.illumination, self._terms, 1)
        self.page = on_modulator(device.modulation.page_light(np.angle(symbols)), self._samples) * illumination
        written = np.pad(np.mod(on_modulator(np.angle(symbols), self._samples).real, 2 * np.pi), 1, mode="edge")
        self.steps = np.stack([np.diff(written[1:-1], 2, axis=1), np.diff(written[:, 1:-1], 2, axis=0)])
        places = np.stack(np.meshgrid(self._grid.x_m, self._grid.y_m), axis=-1).reshape(-1, 2)
        pixels = twin.pixels(device.parameters, places).reshape(2, *self._grid.shape, 2)
        edge, size = len(self._grid.prefilter), np.array(pair.in_phase.shape[::-1])
        self._seen = np.all((pixels > edge) & (pixels < size - edge), axis=(0, 3))
        self._at = _rows_and_columns(pixels)
        self._levels = [smooth_reference(each) for each in (device.references.in_phase, device.references.quadrature)]
        self.references = _looked_at(self._levels, self._at)
        amplitude = np.sqrt(self.references[0])
        self._amplitude = amplitude / amplitude[self._seen].mean()
        self._arms = np.exp(1j * np.array([0.0, device.quadrature_phase_rad]))[:, None, None]
        seen, empty = ((each.in_phase, each.quadrature) for each in (pair, device.references))
        beyond = [one.astype(np.float32) - other for one, other in zip(seen, empty, strict=True)]
        self._images = _filtered(beyond, self._grid.prefilter)
        self.counts = _looked_at(self._images, self._at) / (2 * self.references)
        self.fields = self.waves.to_cameras(self.page)
        self._excess = np.zeros_like(self.counts)  # of the mean counts over the expected ones, see `correct_counts`

    @property
    def left(self) -> Complex:
        """Residual of the model: light of both cameras that would explain what it leaves, complex [2, Gy, Gx]."""
        return self._mending(self._lacking)

    def seen_of(self, change: Complex) -> Complex:
        """A small change of the light of both cameras as it comes back from their equations."""
        return self._mending((change / self._amplitude * self._along().conj()).real)

    def expected_frames(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Counts that the model predicts for both cameras' pixels, [H, W]; NaN beyond the common grid."""
        in_phase, quadrature = (
            on_pixels(brightness, at, level.shape) * level
            for brightness, at, level in zip(self.brightness, self._at, self._levels, strict=True)
        )
        return in_phase, quadrature

    def noise_of_frames(self) -> Complex:
        """Noise like that of the frames over the light that the model predicts, as light of both cameras."""
        pair, references = self._pair, self._device.references
        frames = [pair.in_phase, references.in_phase, pair.quadrature, references.quadrature]
        in_phase, quadrature = self.expected_frames()
        expected = [in_phase, self._levels[0], quadrature, self._levels[1]]
        drawn = list(zip(frames, expected, np.random.default_rng(0).spawn(len(frames)), strict=True))
        noise = list(in_parallel(lambda one: noise_like(*one), drawn))
        beyond = [noise[0] - noise[1], noise[2] - noise[3]]
        return self._mending(_looked_at(_filtered(beyond, self._grid.prefilter), self._at) / (2 * self.references))

    def noise_of_modulator(self) -> Complex:
        """Return the light that the modulator's phase noise of 1 rad a sample adds for both cameras, to first order."""
        noise = np.random.default_rng(1).standard_normal(self.page.shape)
        return self.seen_of(self.waves.to_cameras(1j * noise * self.page))

    def errors(self, leaving: Complex) -> Complex:
        """Light on the exit facet as relative errors of the symbols, over the power of each, [ny, nx]."""
        samples, (rows, columns) = self._samples, self._device.profile.page_shape
        blocks = (rows, samples, columns, samples)
        products = self.page.conj() * self.waves.back_to_page(leaving)
        power = np.abs(self.page) ** 2
        return np.asarray(products.reshape(blocks).sum(axis=(1, 3)) / power.reshape(blocks).sum(axis=(1, 3)))

    def correct_amplitude(self) -> None:
        """Give the model the illumination, and the loss towards the entrance facet's edges, that suit it best.

        A blur of the modulator loses light there. A network learns both by itself.
        """
        terms, waves = len(self._terms), self.waves
        page, share = self.page, 2 if self._samples % 4 == 0 else 1
        coarse, (rows, columns) = self.changed(samples=self._samples // share), page.shape
        page = page.reshape(rows // share, share, columns // share, share).mean(axis=(1, 3)) * share  # as bright
        lighting = illumination_terms(coarse.x, coarse.y)
        first = coarse.to_cameras(page * lighting[0])  # lenses are made before threads ask for them
        lit = [first, *in_parallel(lambda term: coarse.to_cameras(page * term), lighting[1:])]
        losses = [coarse.to_exit(page, radius2(coarse) ** power) for power in _LOSSES]
        changes = [*lit, *(1j * each for each in lit), *map(coarse.from_exit, losses)]
        columns = np.stack([*map(self.equations_of, changes)], axis=1)
        found = np.linalg.lstsq(columns, self.left_of_equations, rcond=None)[0]
        self.page = self.page * (1 + np.tensordot(found[:terms] + 1j * found[terms : 2 * terms], self._terms, 1))
        passed = 1 + sum(
            share * radius2(waves) ** power for share, power in zip(found[2 * terms :], _LOSSES, strict=True)
        )
        self.fields = waves.from_exit(waves.to_exit(self.page, passed))

    def correct_counts(self) -> None:
        """Give the model the mean count over the expected count: cameras clip at zero, and may not be linear.

        A network learns that by itself, and an estimator has such statistics in its table.
        """
        for camera, (level, brightness) in enumerate(zip(self.references, self.brightness, strict=True)):
            expected, counts = level * brightness, level * (1 + 2 * self.counts[camera])
            excess = CountCurve.measured(expected[self._seen], (counts - expected)[self._seen])
            self._excess[camera] = excess.at(expected) / (2 * level)

    def equations(self, left: Real) -> Real:
        """Equations [2, Gy, Gx], or on the coarse grid, over their noise, on that grid; flat."""
        if left.shape[1:] == self._seen.shape:
            left = left[:, *self._every]
        weighted = left / np.sqrt(np.abs(self._along(self._every)) ** 2 + READ_NOISE)
        return np.asarray(weighted[:, self._seen[self._every]].ravel())

    def equations_of(self, change: Complex) -> Real:
        """Return the change of the equations, flat, by a small change of both cameras' light on the coarse grid."""
        return self.equations((change / self._amplitude[self._every] * self._along(self._every).conj()).real)

    def equations_of_fit(self) -> Iterator[Real]:
        """Yield the change of the equations by a small change of each parameter that the twin knows; each flat."""
        leaving = self.coarse.to_exit(self.page)
        here = self.coarse.from_exit(leaving)
        places = np.stack(np.meshgrid(self._grid.x_m, self._grid.y_m), axis=-1)[self._every]
        for index in range(min(self._twin.known, len(PARAMETERS))):
            moved = self._device.parameters.copy()
            moved[index] += STEPS[index]
            if index in SEEN_BY_CAMERAS:
                at = _rows_and_columns(self._twin.pixels(moved, places.reshape(-1, 2)).reshape(2, *places.shape))
                yield self.equations(
                    _looked_at(self._images, at) / (2 * self.references[:, *self._every]) - self.counts[:, *self._every]
                )
            else:
                there = self.coarse.moved(index, self.changed(moved), self.page, leaving, here)
                yield self.equations_of(there - here)

    @property
    def coarse_places(self) -> tuple[Real, Real]:
        """Places (x, y) of the coarse grid over its half width and half height, to be spread over it."""
        x, y = self._grid.x_m[:: self._stride], self._grid.y_m[:: self._stride]
        return (x / self._grid.x_m[-1])[None, :], (y / self._grid.y_m[-1])[:, None]

    @property
    def brightness(self) -> Real:
        """Counts that the model expects, over the reference's counts, [2, Gy, Gx]."""
        return np.abs(self._along()) ** 2

    @property
    def left_of_equations(self) -> Real:
        """Residual of the equations on the coarse grid, over their noise; flat."""
        return self.equations(self._lacking)

    @cached_property
    def coarse(self) -> FittedWaves:
        """The fitted waves on the coarse grid."""
        return self.changed()

    def changed(self, parameters: Real | None = None, samples: int | None = None, **geometry: float) -> FittedWaves:
        """The waves on the coarse grid with other parameters, fewer samples a symbol, or another geometry."""
        parameters = self._device.parameters if parameters is None else parameters
        coarse: dict[str, Any] = {"filled": True, "stride": self._stride, "accuracy": _ACCURACY}
        coarse |= {"changed": geometry, "blur": self._blur, "like": vars(self).get("coarse")}
        return FittedWaves(self._device.profile, parameters, samples or self._samples, **coarse)

    @property
    def _lacking(self) -> Real:
        """Counts that the model lacks, [2, Gy, Gx], over twice the reference's."""
        field = self.fields / self._amplitude
        return np.asarray(self.counts - self._excess - (field * self._arms.conj()).real - np.abs(field) ** 2 / 2)

    def _along(self, where: tuple[slice, slice] = _EVERYWHERE) -> Complex:
        """Directions of the field along which the cameras' counts grow, at some places of the grid."""
        return np.asarray(self._arms + self.fields[:, *where] / self._amplitude[where])

    def _mending(self, left: Real) -> Complex:
        """Light of both cameras that mends what is left of their equations, each weighted by its noise."""
        along = self._along()
        return np.asarray(self._seen * self._amplitude * along * left / (np.abs(along) ** 2 + READ_NOISE))


def places_on_facet(waves: FittedWaves) -> tuple[Real, Real]:
    """Places (x, y) of the facets' samples, over half of the pipe's width, along the lens's axes."""
    channel = waves.channel
    half = channel.geometry.pipe_width_m / 2
    down, across = (facet_axis(count, 2 * half) / half for count in channel.cells)
    x, y = on_facet(couplings(channel.geometry), across, down[:, None])
    return np.asarray(x), np.asarray(y)


def radius2(waves: FittedWaves) -> Real:
    """R^2 of the facets' samples, over the square of half of the pipe's width."""
    return np.asarray(waves.channel.facet_radius2_m2 / (waves.channel.geometry.pipe_width_m / 2) ** 2, np.float64)


def _rows_and_columns(pixels: Real) -> list[list[Real]]:
    """Pixels (column, row) of both cameras, [2, ..., 2], as scipy takes them."""
    return [[each[..., 1], each[..., 0]] for each in pixels]


def _looked_at(images: Sequence[NDArray[np.float32]], at: Sequence[Sequence[Real]]) -> Real:
    """Values of either camera's image at its pixels (row, column)."""
    seen = [
        scipy.ndimage.map_coordinates(one, pixels, order=1, mode="nearest")
        for one, pixels in zip(images, at, strict=True)
    ]
    return np.stack(seen).astype(np.float64)


def _filtered(images: Sequence[NDArray[np.float32]], taps: Real) -> list[NDArray[np.float32]]:
    """Images filtered as a decoder filters what frames have beyond their references, float32 [H, W]."""

    def filtered(image: NDArray[np.float32]) -> NDArray[np.float32]:
        down = scipy.ndimage.convolve1d(image, taps, axis=0)
        return np.asarray(scipy.ndimage.convolve1d(down, taps, axis=1))

    return list(in_parallel(filtered, images))
