"""How well a fitted device explains the light of a known page: in bits, by place, and what is likeliest to be wrong.

What the cameras should have seen of the page, by the fitted waves, is taken off what they saw. The rest is sent back to
the modulator, where it is an error of each symbol, as a decoder meets it that knows all others. Noise of the frames is
measured by the frames themselves, and goes the same way. Noise of the modulator makes errors of phase, and few of
amplitude; light that the model has in another place makes as much of the one as of the other. So the errors of
amplitude, beyond what noise leaves, are those that a better model would not make.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import cached_property
from typing import Annotated, Literal

import numpy as np
import scipy
from numpy.typing import NDArray
from pydantic import Field

from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.frame_noise import with_more_noise
from lightpage.calibration.interfaces import Twin
from lightpage.calibration.samplers import smooth_reference
from lightpage.calibration.waves.wave_model import FittedWaves, illumination_terms, on_modulator
from lightpage.device.profile import TomlTable
from lightpage.recording.frame_pair import FramePair
from lightpage.waves.geometry import couplings, facet_axis, on_facet
from lightpage.waves.grid import field_grid, symbol_samples

Real = NDArray[np.float64]
Complex = NDArray[np.complexfloating]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Map = list[list[NonNegative]]
Verdict = Literal["good", "usable", "wrong"]

GOOD, USABLE = 0.1, 0.3
"""Bits a symbol that a fit may lose against one that explains all light, to be called so."""
_OWN_ERROR_RAD = 0.0165
"""Error of phase of a symbol that the standard decoder adds to that of noise: with the noise of a usual device, 0.009,
it reads 6.3 bits."""
_FLOOR = 0.3
"""Variance of an equation that does not grow with the light, over the shot noise of the reference alone."""
_MORE_NOISE = 3.0
"""Times the frames' own noise: rounding to whole counts, which adds some, then hardly counts."""
_STRIDE, _ACCURACY = 4, 3 / 8
"""Samples of the common grid from one to the next, and share of the splitting steps, for corrections of the model: few
unknowns need few equations."""
_EVERY = (slice(None, None, _STRIDE), slice(None, None, _STRIDE))
_LOSSES = (1, 2)
"""Powers of R^2 in the light that is lost towards the edges of the entrance facet."""
_BENDS = ((2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))
"""Powers of (x, y) of phases over the page."""
_STEP = 1e-4
_SMOOTHED = 9
"""Symbols, side of the squares over whose mean a symbol's error does not count: a network learns what is smooth."""
_EDGE = 2
"""Symbols along the page's edges that are left out: part of their light may miss the cameras."""
_BLOCKS = (6, 8)
"""Rows and columns of the maps."""
_LOCAL = 0.3
"""Share of the errors' power in a hundredth of the symbols from which on it lies in few places; noise has 0.06."""
_FOREIGN = 0.1
"""Mean square of the symbols' relative errors from which on light belongs to other symbols."""
_TELLING = 0.2
"""Share of the unexplained light from which on a correction of the model is called the likeliest cause."""


class Goodness(TomlTable):
    """How well a fit explains the light of a known page.

    Attributes:
        verdict: good, usable or wrong, by `bits_lost`.
        bits_lost: bits a symbol that the standard decoder loses against one whose model explains all light, estimated.
        unexplained_relative: power of what a better model would explain, over the signal's, symbol by symbol.
        noise_relative: power of all noise, over the signal's: that of the frames and that of the modulator.
        modulator_noise_rad: noise of phase of the modulator, a sample of `symbol_samples`.
        by_page: light that is left over what noise leaves, in blocks over the page, rows from the top; 1 is noise.
        by_facet: the same over the pipe's exit facet.
        cause: what is likeliest to be wrong, in words; empty where nothing is.
    """

    verdict: Verdict
    bits_lost: NonNegative
    unexplained_relative: NonNegative
    noise_relative: NonNegative
    modulator_noise_rad: NonNegative
    by_page: Map
    by_facet: Map
    cause: str


def measure_goodness(
    twin: Twin,
    device: CalibratedDevice,
    illumination: Complex,
    pair: FramePair,
    symbols: NDArray[np.complex128],
    progress: Callable[[float], None] = lambda share: None,
) -> Goodness:
    """Measure how well a fitted device explains the light of a known page.

    Args:
        twin: ray tracer of the nominal device.
        device: as it was fitted.
        illumination: coefficients [T] of the page's, as `WaveFitted` has them.
        pair: frames of the page.
        symbols: its unit phasors [ny, nx].
        progress: told of the share that is behind.
    """
    light = _Light(twin, device, illumination, pair, symbols)
    progress(0.2)
    light.correct_amplitude()
    progress(0.4)
    at_exit = [light.to_exit(each) for each in (light.left, light.noise_of_frames(), light.noise_of_modulator())]
    progress(0.6)
    gain = _smooth(light.errors(light.to_exit(light.seen_of(light.fields))).real)
    errors, of_frames, of_modulator = (_rough(light.errors(each) / gain) for each in at_exit)
    errors, by_level = _without_levels(errors, np.angle(symbols))
    progress(0.8)
    # Of errors of amplitude and of phase: what a better model explains is in both, noise of the modulator in phase.
    here, frames, modulator = (_powers(each) for each in (errors, of_frames, of_modulator))
    amplitude, phase = np.maximum(here - frames, 0)
    leak = modulator[0] / modulator[1]
    unexplained = max(0.0, float((amplitude - leak * phase) / (1 - leak)))
    amount = max(0.0, float(phase - unexplained)) / modulator[1]
    noise = frames + amount * modulator
    lost = float(np.log2(1 + (unexplained + by_level) / (noise[1] + _OWN_ERROR_RAD**2))) / 2
    cause = "" if lost < GOOD else _likeliest(light, errors, levels=by_level > unexplained)
    return Goodness(
        verdict="good" if lost < GOOD else "usable" if lost < USABLE else "wrong",
        bits_lost=lost,
        unexplained_relative=2 * unexplained + by_level,
        noise_relative=float(noise.sum()),
        modulator_noise_rad=float(np.sqrt(amount)),
        by_page=_map(errors, of_frames, amount, of_modulator),
        by_facet=_map(at_exit[0], at_exit[1], amount, at_exit[2]),
        cause=cause,
    )


class _Light:
    """The light of a known page as cameras saw it, and as the fitted waves have it.

    Light of both cameras is [2, Gy, Gx], on the common grid.

    Attributes:
        fields: what either camera should see.
    """

    def __init__(
        self,
        twin: Twin,
        device: CalibratedDevice,
        illumination: Complex,
        pair: FramePair,
        symbols: NDArray[np.complex128],
    ) -> None:
        self._device, self._pair, profile = device, pair, device.profile
        self._samples, self._grid = symbol_samples(profile), field_grid(profile)
        self._waves = FittedWaves(profile, device.parameters, self._samples, filled=True)
        self._terms = np.stack(illumination_terms(self._waves.x, self._waves.y))
        lit = np.tensordot(illumination, self._terms, 1)
        self._page = on_modulator(device.modulation.light(np.angle(symbols)), self._samples) * lit
        places = np.stack(np.meshgrid(self._grid.x_m, self._grid.y_m), axis=-1).reshape(-1, 2)
        pixels = twin.pixels(device.parameters, places).reshape(2, *self._grid.shape, 2)
        edge, size = len(self._grid.prefilter), np.array(pair.in_phase.shape[::-1])
        self._seen = np.all((pixels > edge) & (pixels < size - edge), axis=(0, 3))
        self._at = [[each[..., 1], each[..., 0]] for each in pixels]
        levels = [smooth_reference(each) for each in (device.references.in_phase, device.references.quadrature)]
        self._references = np.stack([_sampled(each, at) for each, at in zip(levels, self._at, strict=True)])
        amplitude = np.sqrt(self._references[0])
        self._amplitude = amplitude / amplitude[self._seen].mean()
        self._arms = np.exp(1j * np.array([0.0, device.quadrature_phase_rad]))[:, None, None]
        self._counts = self._measured(pair, device.references)
        self.fields = self._waves.to_cameras(self._page)

    @property
    def left(self) -> Complex:
        """What the model leaves, as light of both cameras that would mend it."""
        field = self.fields / self._amplitude
        return self._mending(self._counts - (field * self._arms.conj()).real - np.abs(field) ** 2 / 2)

    def seen_of(self, change: Complex) -> Complex:
        """A small change of the light of both cameras as it comes back from their equations."""
        return self._mending((change / self._amplitude * self._along.conj()).real)

    def noise_of_frames(self) -> Complex:
        """Noise like that of the frames, as light of both cameras."""
        rng = np.random.default_rng(0)
        frames, references = (
            FramePair(*(with_more_noise(frame, _MORE_NOISE, rng) for frame in (pair.in_phase, pair.quadrature)))
            for pair in (self._pair, self._device.references)
        )
        return self._mending((self._measured(frames, references) - self._counts) / _MORE_NOISE)

    def noise_of_modulator(self) -> Complex:
        """What a radian of phase noise, another in each sample, adds to what the cameras see, to first order."""
        noise = np.random.default_rng(1).standard_normal(self._page.shape)
        return self.seen_of(self._waves.to_cameras(1j * noise * self._page))

    def to_exit(self, seen: Complex) -> Complex:
        """Light of both cameras back to the exit facet."""
        return self._waves.back_to_exit(seen)

    def errors(self, leaving: Complex) -> Complex:
        """Light on the exit facet as relative errors of the symbols, over the power of each, [ny, nx]."""
        samples, (rows, columns) = self._samples, self._device.profile.page_shape
        blocks = (rows, samples, columns, samples)
        products = self._page.conj() * self._waves.back_to_page(leaving)
        power = np.abs(self._page) ** 2
        return np.asarray(products.reshape(blocks).sum(axis=(1, 3)) / power.reshape(blocks).sum(axis=(1, 3)))

    def correct_amplitude(self) -> None:
        """Give the model the illumination, and the loss towards the entrance facet's edges, that suit it best.

        A blur of the modulator loses light there. A network learns both by itself.
        """
        terms, waves = len(self._terms), self._waves
        lit = [self._coarse.to_cameras(self._page * term) for term in self._terms]
        losses = [self._coarse_exit(self._coarse_radius2**power) for power in _LOSSES]
        changes = [*lit, *(1j * each for each in lit), *map(self._coarse.from_exit, losses)]
        found = self.explained(map(self.equations_of, changes))[1]
        self._page = self._page * (1 + np.tensordot(found[:terms] + 1j * found[terms : 2 * terms], self._terms, 1))
        radius2 = _radius2(waves)
        passed = 1 + sum(share * radius2**power for share, power in zip(found[2 * terms :], _LOSSES, strict=True))
        self.fields = waves.from_exit(waves.to_exit(self._page, passed))

    def explained(self, columns: Iterable[Real]) -> tuple[float, Real]:
        """Share of what is left of the equations that is explained by these changes of them, and how much of each."""
        field = self.fields / self._amplitude
        left = self._equations(self._counts - (field * self._arms.conj()).real - np.abs(field) ** 2 / 2)
        matrix = np.stack([*columns], axis=1)
        unit = 1 / np.linalg.norm(matrix, axis=0)
        found = np.linalg.lstsq(matrix * unit, left, rcond=None)[0] * unit
        return 1 - float(np.sum((left - matrix @ found) ** 2) / np.sum(left**2)), found

    def equations_of(self, change: Complex) -> Real:
        """What a small change of the light does to the equations; light of both cameras on the coarse grid."""
        every = (..., *_EVERY)
        return self._equations((change / self._amplitude[every[1:]] * self._along[every].conj()).real)

    def _equations(self, left: Real) -> Real:
        """Equations [2, Gy, Gx], or on the coarse grid, over their noise, on that grid; flat."""
        if left.shape[1:] == self._seen.shape:
            left = left[:, *_EVERY]
        weighted = left / np.sqrt(np.abs(self._along[:, *_EVERY]) ** 2 + _FLOOR)
        return np.asarray(weighted[:, self._seen[_EVERY]].ravel())

    def suspects(self) -> Iterator[tuple[str, list[Real]]]:
        """What may be wrong, in words, and how it would change the equations."""
        leaving, (across, up) = self._coarse_exit(), _places_on_facet(self._coarse)
        radius2, one = self._coarse_radius2, np.array([1, 0])[:, None, None]

        def each_camera(change: Complex) -> list[Real]:
            return [self.equations_of(change * chosen) for chosen in (one, 1 - one)]

        def at_exit(factor: Real) -> Complex:
            return self._coarse.from_exit(1j * leaving * factor)

        yield "a curvature over the exit facet: are the cameras in focus?", each_camera(at_exit(radius2))
        tilts = [*each_camera(at_exit(across)), *each_camera(at_exit(up))]
        yield "a slope over the exit facet: do the cameras see the image where they were registered?", tilts
        astigmatic = [self.equations_of(at_exit(each)) for each in (across**2 - up**2, across * up)]
        yield "a saddle over the exit facet: is the second lens, or the pipe's end, askew?", astigmatic
        entering = self._coarse.from_exit(self._coarse_exit(1j * radius2))
        yield "a curvature over the entrance facet: is the modulator in focus?", [self.equations_of(entering)]
        x, y = self._waves.x[None, :], self._waves.y[:, None]
        bent = [self._coarse.to_cameras(1j * self._page * x**i * y**j) for i, j in _BENDS]
        yield "a phase over the page: is the modulator flat, is its lens right?", [*map(self.equations_of, bent)]
        here = self._coarse.from_exit(leaving)
        higher = self._changed(pipe_height_relative=_STEP).to_cameras(self._page)
        yield "walls of the pipe that are not equally far apart in x and y", [self.equations_of(higher - here)]
        length = self._waves.channel.geometry.pipe_length_m
        ghost = self._changed(pipe_length_m=3 * length).to_cameras(self._page)
        yield "light that passes the pipe three times", [*map(self.equations_of, (ghost, 1j * ghost))]
        bright = self._references * (self._counts + 0.5) ** 2
        yield "counts that are not in proportion to the light", [self._equations(bright * c) for c in (one, 1 - one)]

    @cached_property
    def _coarse(self) -> FittedWaves:
        return self._changed()

    def _changed(self, **geometry: float) -> FittedWaves:
        """The waves on the coarse grid, with another geometry."""
        profile, parameters = self._device.profile, self._device.parameters
        how = {"filled": True, "stride": _STRIDE, "accuracy": _ACCURACY}
        return FittedWaves(profile, parameters, self._samples, **how, changed=geometry)

    def _coarse_exit(self, passed: Complex | Real | float = 1.0) -> Complex:
        """The page's light on the exit facet, where the entrance facet lets so much of it pass."""
        return self._coarse.to_exit(self._page, passed)

    @property
    def _coarse_radius2(self) -> Real:
        return _radius2(self._coarse)

    @property
    def _along(self) -> Complex:
        """Directions of the field along which the cameras' counts grow."""
        return self._arms + self.fields / self._amplitude

    def _mending(self, left: Real) -> Complex:
        """Light of both cameras that mends what is left of their equations, each weighted by its noise."""
        along = self._along
        return np.asarray(self._seen * self._amplitude * along * left / (np.abs(along) ** 2 + _FLOOR))

    def _measured(self, pair: FramePair, references: FramePair) -> Real:
        """Counts over twice the reference's, less one half, [2, Gy, Gx], as a decoder has them."""
        measured = []
        for camera, (frame, reference) in enumerate(
            ((pair.in_phase, references.in_phase), (pair.quadrature, references.quadrature))
        ):
            beyond = frame.astype(np.float32) - reference
            for axis in (0, 1):
                beyond = scipy.ndimage.convolve1d(beyond, self._grid.prefilter, axis=axis)
            measured.append(_sampled(beyond, self._at[camera]) / (2 * self._references[camera]))
        return np.stack(measured)


def _likeliest(light: _Light, errors: Complex, *, levels: bool) -> str:
    """What is likeliest to be wrong, in words."""
    if levels:
        return "levels whose phases no smooth curve tells: is the modulator's lookup table right?"
    words, share = max(
        ((words, light.explained(columns)[0]) for words, columns in light.suspects()), key=lambda found: found[1]
    )
    if share > _TELLING:
        return f"{words} ({share:.0%} of what is left)"
    power = np.sort(np.abs(errors).ravel() ** 2)
    if power[-len(power) // 100 :].sum() > _LOCAL * power.sum():
        return "light in few places: dust, hot or dead pixels?"
    if power.mean() > _FOREIGN:
        return "light of other symbols: are these the pages that were written?"
    return "nothing that the model knows: light comes by a way that it lacks, or symbols are not as they were written"


def _places_on_facet(waves: FittedWaves) -> tuple[Real, Real]:
    """Places (x, y) of the facets' samples, over half of the pipe's width, along the lens's axes."""
    channel = waves.channel
    half = channel.geometry.pipe_width_m / 2
    down, across = (facet_axis(count, 2 * half) / half for count in channel.cells)
    x, y = on_facet(couplings(channel.geometry), across, down[:, None])
    return np.asarray(x), np.asarray(y)


def _radius2(waves: FittedWaves) -> Real:
    x, y = _places_on_facet(waves)
    return x**2 + y**2


def _sampled(image: NDArray[np.float32], at: list[Real]) -> Real:
    return np.asarray(scipy.ndimage.map_coordinates(image, at, order=1, mode="nearest"), dtype=np.float64)


def _smooth(errors: Real) -> Real:
    return np.asarray(scipy.ndimage.uniform_filter(errors, _SMOOTHED))


def _rough(errors: Complex) -> Complex:
    """Errors less what is smooth in them, the page's edges left out."""
    rough = errors - _smooth(errors.real) - 1j * _smooth(errors.imag)
    return np.asarray(rough[_EDGE:-_EDGE, _EDGE:-_EDGE])


def _without_levels(errors: Complex, phases: Real) -> tuple[Complex, float]:
    """Errors less the mean of their level, and the variance of phase of what those means are beyond chance."""
    _, level = np.unique(np.round(phases[_EDGE:-_EDGE, _EDGE:-_EDGE].ravel(), 6), return_inverse=True)
    count = np.bincount(level)
    flat = errors.ravel()
    mean = (np.bincount(level, flat.real) + 1j * np.bincount(level, flat.imag)) / count
    several = count[level] > 1
    left = np.where(several, (flat - mean[level]) * np.sqrt(count[level] / np.maximum(count[level] - 1, 1)), flat)
    chance = np.mean(left.imag**2) * len(count) / len(flat)
    return left.reshape(errors.shape), max(0.0, float(np.mean(mean.imag[level] ** 2) - chance))


def _powers(errors: Complex) -> Real:
    """Mean square of the errors of amplitude and of phase, [2]."""
    return np.array([np.mean(errors.real**2), np.mean(errors.imag**2)])


def _map(here: Complex, frames: Complex, amount: float, modulator: Complex) -> Map:
    """Power of what is left over that of noise, in blocks."""

    def blocks(light: Complex) -> Real:
        rows = np.array_split(np.abs(light) ** 2, _BLOCKS[0], axis=0)
        return np.array([[part.mean() for part in np.array_split(row, _BLOCKS[1], axis=1)] for row in rows])

    ratio = blocks(here) / (blocks(frames) + amount * blocks(modulator))
    return [[round(float(one), 3) for one in row] for row in ratio]
