"""The light of the pilots of some pages, as both cameras show it where a geometry puts it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy
from numpy.typing import NDArray

from lightpage.calibration.coherence import branch_shares
from lightpage.calibration.interfaces import BRANCHES, Twin
from lightpage.calibration.samplers import linear_light
from lightpage.calibration.sampling_table import symbol_centres
from lightpage.device.profile import Profile
from lightpage.page.pilots import Pilots
from lightpage.recording.frame_pair import FramePair

Real = NDArray[np.float64]
Complex = NDArray[np.complexfloating]

_SAMPLES = 3
"""Points of a symbol along either axis."""


class PilotLight:
    """Looks at the pilots of pages of one device.

    Each frame by itself is a linear estimate of the field: its conjugate averages out over a symbol.

    Args:
        twin: ray tracer of the nominal device.
        profile: the nominal device.
        pairs, references: frames of the pages, and reference-only ones.
        pilots: which all of the pages carry.

    Attributes:
        centres: of the pilots on the page, (x, y), metres, [N, 2].
    """

    def __init__(
        self, twin: Twin, profile: Profile, pairs: Sequence[FramePair], references: FramePair, pilots: Pilots
    ) -> None:
        self._twin, self._phases = twin, pilots.phases
        self._images = [
            [linear_light(frame, reference) for frame in frames]
            for frames, reference in (
                ([pair.in_phase for pair in pairs], references.in_phase),
                ([pair.quadrature for pair in pairs], references.quadrature),
            )
        ]
        self.centres = symbol_centres(profile)[pilots.mask.ravel()]
        steps = ((np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5) * profile.symbol_pitch_m
        offsets = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
        self._points = (self.centres[:, None] + offsets).reshape(-1, 2)
        self._anchors = np.repeat(self.centres, len(offsets), axis=0)

    def shares(self, parameters: Real, branches: Sequence[str]) -> Real:
        """Share of each branch in the pilots' light, [branches, N]."""
        return branch_shares(self._twin.trace(parameters, self.centres).positions, branches)

    def seen(self, parameters: Real, branches: Sequence[str], shift_m: tuple[float, float] = (0.0, 0.0)) -> Complex:
        """Light of every pilot along every branch, its symbol's and its path's phase off.

        Args:
            parameters: [P], the geometry.
            branches: along which light is looked at.
            shift_m: by how much further on it is looked for, (x, y).

        Returns:
            [cameras, pages, branches, N]. Its phase is that of the page and the camera, where the geometry holds.
        """
        pixels, conjugate = self._look(parameters, branches, shift_m)
        return self._summed(pixels, conjugate)

    def slopes(
        self, parameters: Real, branches: Sequence[str], free: Sequence[int], steps: Real
    ) -> tuple[Complex, Complex]:
        """The same light, and its derivatives by some parameters, [free, cameras, pages, branches, N].

        Args:
            parameters, branches: as for `seen`.
            free: positions of the parameters.
            steps: finite differences, one each.
        """
        pixels, conjugate = self._look(parameters, branches)
        light = self._summed(pixels, conjugate)
        across = [
            self._summed(pixels + axis, conjugate) - self._summed(pixels - axis, conjugate) for axis in np.eye(2) / 2
        ]
        chosen = [BRANCHES.index(name) for name in branches]
        geometries = np.tile(parameters, (len(free) + 1, 1))
        geometries[np.arange(len(free)), list(free)] += steps
        rays = self._twin.trace(geometries, self.centres)
        pixels_of = [
            self._twin.pixels(one, places[chosen].reshape(-1, 2))
            for one, places in zip(geometries, rays.places, strict=True)
        ]
        middles = np.reshape(pixels_of, (len(geometries), -1, 1, *light.shape[-2:], 2))
        moved = np.moveaxis(middles[:-1] - middles[-1], -1, 0)
        turned = (rays.phases[:-1, chosen] - rays.phases[-1, chosen])[:, None, None]
        changes = across[0] * moved[0] + across[1] * moved[1] - 1j * turned * light
        return light, changes / steps[:, None, None, None, None]

    def _look(
        self, parameters: Real, branches: Sequence[str], shift_m: tuple[float, float] = (0.0, 0.0)
    ) -> tuple[Real, Complex]:
        """Return the pilots' points on both cameras [cameras, B, N, S, 2], and the phasor of their phase [B, N, S]."""
        rays = self._twin.trace(parameters, self._points, self._anchors)
        chosen, shape = [BRANCHES.index(name) for name in branches], (len(branches), len(self.centres), _SAMPLES**2)
        phases = rays.phases[chosen].reshape(shape) + self._phases[:, None]
        pixels = self._twin.pixels(parameters, (rays.places[chosen] + shift_m).reshape(-1, 2))
        return pixels.reshape(-1, *shape, 2), np.exp(-1j * phases)

    def _summed(self, pixels: Real, conjugate: Complex) -> Complex:
        """Light at pixels, summed over the points of a symbol, [cameras, pages, B, N]."""
        light = [
            [scipy.ndimage.map_coordinates(image, [at[..., 1], at[..., 0]], order=1) for image in images]
            for images, at in zip(self._images, pixels, strict=True)
        ]
        return np.asarray(np.sum(light * conjugate, axis=-1), np.complex128)


def told_nats(light: Complex, expected: Real) -> Real:
    """Information that light tells of a geometry, nats: exponentially distributed, of mean 1, where it is unrelated.

    The phase common to all of it is free.

    Args:
        light: [..., branches, N].
        expected: amplitudes, up to a factor, [branches, N].
    """
    return _coherent(light, expected)[0]


def told_slope(light: Complex, expected: Real) -> Complex:
    """Return the slope of `told_nats`: the real part of its product with a change of light [..., branches, N]."""
    _, share, along, power = _coherent(light, expected)
    by_share = (expected.size - 1) / (1 - share)
    norm = np.sum(expected**2)
    toward = along.conj()[..., None, None] * expected / norm - share[..., None, None] * light.conj()
    return np.asarray(2 * (by_share / power)[..., None, None] * toward, np.complex128)


def _coherent(light: Complex, expected: Real) -> tuple[Real, Real, Complex, Real]:
    """Nats, the coherent share of the power, the coherent sum, and the power of all."""
    along, power = np.sum(light * expected, axis=(-2, -1)), np.maximum(np.sum(np.abs(light) ** 2, axis=(-2, -1)), 1e-30)
    share = np.minimum(np.abs(along) ** 2 / (np.sum(expected**2) * power), 1 - 1e-9)
    return nats(share, expected.size), share, along, power


def nats(share: Real, count: int) -> Real:
    """The same of a share of the power that is coherent, of so many amplitudes."""
    return np.asarray(-(count - 1) * np.log1p(-np.minimum(share, 1 - 1e-9)), np.float64)
