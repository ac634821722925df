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

    def seen(self, parameters: Real, branches: Sequence[str], shifts_m: Real | None = None) -> Complex:
        """Light of every pilot along every branch, its symbol's and its path's phase off.

        Args:
            parameters: [P], the geometry.
            branches: along which light is looked at.
            shifts_m: by how much further on it is looked for, [K, 2] as (x, y); by default not at all, K being 1.

        Returns:
            [K, cameras, pages, branches, N]. Its phase is that of the page and the camera, where the geometry holds.
        """
        rays = self._twin.trace(parameters, self._points, self._anchors)
        chosen, shape = [BRANCHES.index(name) for name in branches], (len(branches), len(self.centres), _SAMPLES**2)
        phases = rays.phases[chosen].reshape(shape) + self._phases[:, None]
        conjugate = np.exp(-1j * phases)
        found = []
        for shift in np.zeros((1, 2)) if shifts_m is None else shifts_m:
            pixels = self._twin.pixels(parameters, (rays.places[chosen] + shift).reshape(-1, 2))
            light = [[_at(image, at) for image in images] for images, at in zip(self._images, pixels, strict=True)]
            found.append(np.sum(np.reshape(light, (len(light), -1, *shape)) * conjugate, axis=-1))
        return np.stack(found)


def told_nats(light: Complex, expected: Real) -> Real:
    """Information that light tells of a geometry, nats: exponentially distributed, of mean 1, where it is unrelated.

    The phase common to all of it is free.

    Args:
        light: [..., branches, N].
        expected: amplitudes, up to a factor, [branches, N].
    """
    along = np.abs(np.sum(light * expected, axis=(-2, -1))) ** 2
    of_all = np.sum(expected**2) * np.sum(np.abs(light) ** 2, axis=(-2, -1))
    return nats(along / np.maximum(of_all, 1e-30), expected.size)


def nats(share: Real, count: int) -> Real:
    """The same of a share of the power that is coherent, of so many amplitudes."""
    return np.asarray(-(count - 1) * np.log1p(-np.minimum(share, 1 - 1e-9)), np.float64)


def _at(image: NDArray[np.float32], pixels: Real) -> Real:
    """Values at pixels [N, 2] (column, row)."""
    return np.asarray(scipy.ndimage.map_coordinates(image, [pixels[:, 1], pixels[:, 0]], order=1), np.float64)
