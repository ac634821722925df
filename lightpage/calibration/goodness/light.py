"""Light of a known page: as the cameras measured it, and as the fitted waves predict it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.goodness.frame_noise import CountCurve, noise_like, on_pixels
from lightpage.calibration.interfaces import Twin
from lightpage.calibration.samplers import smooth_reference
from lightpage.calibration.waves.wave_fit import READ_NOISE
from lightpage.calibration.waves.wave_model import FittedWaves, LaunchConditions, illumination_terms, on_modulator
from lightpage.recording.frame_pair import FramePair
from lightpage.waves.geometry import couplings, facet_axis, on_facet
from lightpage.waves.grid import field_grid, symbol_samples
from lightpage.waves.parallel import in_parallel

Real = NDArray[np.float64]
Complex = NDArray[np.complexfloating]

_EQUATIONS = 30_000
"""Approximate limit of each camera's equations from which the model is corrected: there are few unknowns."""
_LEAST_STRIDE = 4
"""Least distance between two of them, samples of the common grid."""
_EVERYWHERE = (slice(None), slice(None))
_ACCURACY = 3 / 8
"""Share of the splitting steps that waves for corrections take."""
_LOSSES = (1, 2)
"""Powers of R^2 in the loss of light towards the edges of the entrance facet."""


class PageLight:
    """Light of a known page: as the cameras measured it, and as the fitted waves predict it.

    Light of both cameras is on the common grid, [2, Gy, Gx].

    Attributes:
        twin: ray tracer of the nominal device.
        device: fitted device.
        waves: fitted waves.
        page: light on the modulator, [ny samples, nx samples].
        steps: second differences of the nominal phases of the samples along x, and along y, [2, ny samples,
            nx samples].
        fields: light that the model predicts for each camera.
        counts: frames minus references, over twice the references, [2, Gy, Gx].
        references: counts of the references, [2, Gy, Gx].
        amplitude: amplitude of the reference over its mean, [Gy, Gx].
        arms: phasors of both arms of the homodyne detector, [2, 1, 1].
        visible: places of the grid that both cameras see, [Gy, Gx].
        every: slices of the grid to the coarse grid.
        stride: samples of the grid from one of the coarse grid to the next.
        grid: the common grid.
        at: rows and columns of both cameras' pixels at the places of the grid.
        images: filtered differences of frames and references, [H, W] each.
        pair: frames of the page.
        symbols: unit phasors of the page's symbols, [ny, nx].
    """

    def __init__(
        self,
        twin: Twin,
        device: CalibratedDevice,
        conditions: LaunchConditions,
        pair: FramePair,
        symbols: NDArray[np.complex128],
    ) -> None:
        profile = device.profile
        self.twin = twin
        self.device = device
        self.pair = pair
        self.symbols = symbols
        self._samples = symbol_samples(profile)
        self._coarse_samples = self._samples // 2 if self._samples % 4 == 0 else self._samples
        self.grid = field_grid(profile)
        self.stride = max(_LEAST_STRIDE, int(np.sqrt(np.prod(self.grid.shape) / _EQUATIONS)))
        self.every = (slice(None, None, self.stride), slice(None, None, self.stride))
        self._blur = conditions.blur
        self.waves = FittedWaves(profile, device.parameters, self._samples, filled=True, blur=self._blur)
        self._terms = np.stack(illumination_terms(self.waves.x, self.waves.y))
        illumination = np.tensordot(conditions.illumination, self._terms, 1)
        self.page = on_modulator(device.modulation.page_light(np.angle(symbols)), self._samples) * illumination
        written = np.pad(np.mod(on_modulator(np.angle(symbols), self._samples).real, 2 * np.pi), 1, mode="edge")
        self.steps = np.stack([np.diff(written[1:-1], 2, axis=1), np.diff(written[:, 1:-1], 2, axis=0)])
        places = np.stack(np.meshgrid(self.grid.x_m, self.grid.y_m), axis=-1).reshape(-1, 2)
        pixels = twin.pixels(device.parameters, places).reshape(2, *self.grid.shape, 2)
        edge = len(self.grid.prefilter)
        size = np.array(pair.in_phase.shape[::-1])
        self.visible = np.all((pixels > edge) & (pixels < size - edge), axis=(0, 3))
        self.at = rows_and_columns(pixels)
        self._smooth_references = [
            smooth_reference(each) for each in (device.references.in_phase, device.references.quadrature)
        ]
        self.references = interpolated(self._smooth_references, self.at)
        amplitude = np.sqrt(self.references[0])
        self.amplitude = amplitude / amplitude[self.visible].mean()
        self.arms = np.exp(1j * np.array([0.0, device.quadrature_phase_rad]))[:, None, None]
        references = device.references
        differences = [
            pair.in_phase.astype(np.float32) - references.in_phase,
            pair.quadrature.astype(np.float32) - references.quadrature,
        ]
        self.images = _filtered(differences, self.grid.prefilter)
        self.counts = interpolated(self.images, self.at) / (2 * self.references)
        self.fields = self.waves.to_cameras(self.page)
        self._excess = np.zeros_like(self.counts)
        """Mean excess of the counts over the expected counts, see `correct_counts`."""

    @property
    def residual(self) -> Complex:
        """Residual of the model, as light of both cameras that would explain it, complex [2, Gy, Gx]."""
        return self._explaining_light(self.count_residual)

    def observed_change(self, change: Complex) -> Complex:
        """Estimate a small change of both cameras' light from their equations, which miss its other quadrature."""
        return self._explaining_light((change / self.amplitude * self._count_gradient().conj()).real)

    def expected_frames(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Counts that the model predicts for both cameras' pixels, [H, W]; NaN beyond the common grid."""
        in_phase, quadrature = (
            on_pixels(brightness, at, level.shape) * level
            for brightness, at, level in zip(self.brightness, self.at, self._smooth_references, strict=True)
        )
        return in_phase, quadrature

    def frame_noise(self) -> Complex:
        """Draw noise with the variance of the frames', and return it as light of both cameras."""
        return self._explaining_light(self.drawn_counts)

    @cached_property
    def drawn_counts(self) -> Real:
        """Noise with the variance of the frames', over twice the references, [2, Gy, Gx]."""
        pair = self.pair
        references = self.device.references
        frames = [pair.in_phase, references.in_phase, pair.quadrature, references.quadrature]
        in_phase, quadrature = self.expected_frames()
        expected = [in_phase, self._smooth_references[0], quadrature, self._smooth_references[1]]
        drawn = list(zip(frames, expected, np.random.default_rng(0).spawn(len(frames)), strict=True))
        noise = list(in_parallel(lambda one: noise_like(*one), drawn))
        differences = [noise[0] - noise[1], noise[2] - noise[3]]
        images = _filtered(differences, self.grid.prefilter)
        return interpolated(images, self.at) / (2 * self.references)

    def modulator_noise(self) -> Complex:
        """Draw phase noise of the modulator, 1 rad a sample, and return it as light of both cameras, to first order."""
        noise = np.random.default_rng(1).standard_normal(self.page.shape)
        return self.observed_change(self.waves.to_cameras(1j * noise * self.page))

    def errors(self, leaving: Complex) -> Complex:
        """Project light on the exit facet to relative errors of the symbols, [ny, nx]."""
        rows, columns = self.device.profile.page_shape
        blocks = (rows, self._samples, columns, self._samples)
        products = self.page.conj() * self.waves.back_to_page(leaving)
        power = np.abs(self.page) ** 2
        return np.asarray(products.reshape(blocks).sum(axis=(1, 3)) / power.reshape(blocks).sum(axis=(1, 3)))

    def correct_amplitude(self) -> None:
        """Fit the illumination, and the loss towards the entrance facet's edges, and correct the model by them.

        A blur of the modulator loses light there. A network learns both from its training pages.
        """
        terms = len(self._terms)
        waves = self.waves
        page = coarse_page(self)
        coarse = self.coarse
        lighting = illumination_terms(coarse.x, coarse.y)
        first = coarse.to_cameras(page * lighting[0])  # lenses are made before threads ask for them
        by_illumination = [first, *in_parallel(lambda term: coarse.to_cameras(page * term), lighting[1:])]
        losses = [coarse.to_exit(page, radius2(coarse) ** power) for power in _LOSSES]
        changes = [*by_illumination, *(1j * each for each in by_illumination), *map(coarse.from_exit, losses)]
        matrix = np.stack([*map(self.equations_of, changes)], axis=1)
        found = np.linalg.lstsq(matrix, self.equation_residual, rcond=None)[0]
        self.page = self.page * (1 + np.tensordot(found[:terms] + 1j * found[terms : 2 * terms], self._terms, 1))
        transmission = 1 + sum(
            share * radius2(waves) ** power for share, power in zip(found[2 * terms :], _LOSSES, strict=True)
        )
        self.fields = waves.from_exit(waves.to_exit(self.page, transmission))

    def correct_counts(self) -> None:
        """Measure the mean count as a function of the expected count, and correct the model by it.

        Cameras clip at zero, and may be nonlinear. A network learns that from its training pages. An estimator has such
        statistics in its table.
        """
        for camera, (level, brightness) in enumerate(zip(self.references, self.brightness, strict=True)):
            expected = level * brightness
            counts = level * (1 + 2 * self.counts[camera])
            excess = CountCurve.measured(expected[self.visible], (counts - expected)[self.visible])
            self._excess[camera] = excess.at(expected) / (2 * level)

    def equations(self, residual: Real) -> Real:
        """Weigh equations [2, Gy, Gx], or those of the coarse grid, by their noise; on the coarse grid, flat."""
        if residual.shape[1:] == self.visible.shape:
            residual = residual[:, *self.every]
        weighted = residual / np.sqrt(np.abs(self._count_gradient(self.every)) ** 2 + READ_NOISE)
        return np.asarray(weighted[:, self.visible[self.every]].ravel())

    def equations_of(self, change: Complex) -> Real:
        """Change of the equations, flat, by a small change of both cameras' light on the coarse grid."""
        return self.equations((change / self.amplitude[self.every] * self._count_gradient(self.every).conj()).real)

    def interference_and_power(self) -> tuple[Real, Real]:
        """Interference and power of the predicted light, over the reference's power, [2, Gy, Gx] each."""
        field = self.fields / self.amplitude
        return np.asarray(2 * (field * self.arms.conj()).real), np.asarray(np.abs(field) ** 2)

    @property
    def brightness(self) -> Real:
        """Expected counts over the reference's counts, [2, Gy, Gx]."""
        return np.abs(self._count_gradient()) ** 2

    @property
    def equation_residual(self) -> Real:
        """Residual of the equations on the coarse grid, over their noise, flat."""
        return self.equations(self.count_residual)

    @cached_property
    def coarse(self) -> FittedWaves:
        """The fitted waves from the modulator at half of its rate to the coarse grid."""
        return self.changed()

    def changed(self, parameters: Real | None = None, **geometry: float) -> FittedWaves:
        """Fitted waves like `coarse`, with other parameters or geometry."""
        parameters = self.device.parameters if parameters is None else parameters
        coarse: dict[str, Any] = {"filled": True, "stride": self.stride, "accuracy": _ACCURACY}
        coarse |= {"changed": geometry, "blur": self._blur, "like": vars(self).get("coarse")}
        return FittedWaves(self.device.profile, parameters, self._coarse_samples, **coarse)

    @property
    def count_residual(self) -> Real:
        """Measured minus predicted counts, over twice the reference's, [2, Gy, Gx]."""
        field = self.fields / self.amplitude
        return np.asarray(self.counts - self._excess - (field * self.arms.conj()).real - np.abs(field) ** 2 / 2)

    def _count_gradient(self, where: tuple[slice, slice] = _EVERYWHERE) -> Complex:
        """Gradient of the cameras' counts by the field, at some places of the grid."""
        return np.asarray(self.arms + self.fields[:, *where] / self.amplitude[where])

    def _explaining_light(self, residual: Real) -> Complex:
        """Light of both cameras that explains residuals of their equations [2, Gy, Gx], weighted by their noise."""
        gradient = self._count_gradient()
        return np.asarray(self.visible * self.amplitude * gradient * residual / (np.abs(gradient) ** 2 + READ_NOISE))


def coarse_page(light: PageLight) -> Complex:
    """Light of the modulator at the rate of the coarse waves, and as bright, complex [ny samples, nx samples]."""
    rows, columns = light.page.shape
    share = rows // len(light.coarse.y)
    return np.asarray(light.page.reshape(rows // share, share, columns // share, share).mean(axis=(1, 3)) * share)


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


def rows_and_columns(pixels: Real) -> list[list[Real]]:
    """Rows and columns, as scipy takes them, of pixels (column, row) of both cameras, [2, ..., 2]."""
    return [[each[..., 1], each[..., 0]] for each in pixels]


def interpolated(images: Sequence[NDArray[np.float32]], at: Sequence[Sequence[Real]]) -> Real:
    """Interpolate each camera's image at its pixels (row, column)."""
    values = [
        scipy.ndimage.map_coordinates(one, pixels, order=1, mode="nearest")
        for one, pixels in zip(images, at, strict=True)
    ]
    return np.stack(values).astype(np.float64)


def _filtered(images: Sequence[NDArray[np.float32]], taps: Real) -> list[NDArray[np.float32]]:
    """Filter images as a decoder filters the differences of frames and references, float32 [H, W]."""

    def filtered(image: NDArray[np.float32]) -> NDArray[np.float32]:
        down = scipy.ndimage.convolve1d(image, taps, axis=0)
        return np.asarray(scipy.ndimage.convolve1d(down, taps, axis=1))

    return list(in_parallel(filtered, images))
