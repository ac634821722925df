"""The two cameras' relation: their poses and the angle between the arms, from a known page and the fitted wave model.

What a field that is recovered from two frames is worth depends on how well the frames lie on each other. Once the pipe
is known, the wave model says what each camera should have seen of a known page, the signal's own power included; all
its pixels together then place either camera, whatever the reference's strength.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from optics.grid import field_grid
from optics.profile import Profile
from optics.recording import FramePair
from optics.registration.fitted_waves import FittedWaves, illumination_terms, on_modulator
from optics.registration.parameters import indices
from optics.registration.samplers import smooth_reference
from optics.registration.twin import Twin

Real = NDArray[np.float64]

_ROUNDS = 5
_CONVERGED_PX = 0.003
_LARGEST_MOVE_PX = 1.5
"""A round's largest step: the model is linear in the displacement over about a speckle."""
READ_NOISE = 0.3
"""Variance of an equation that does not grow with the light, over the shot noise of the reference alone."""
_STRIDE = 2
"""Grid samples from one equation to the next: the grid has twice the rate that the light needs."""
_INSIDE = 0.98
"""Share of the page's image that is compared, to either side."""
_SAMPLES = 4
"""Samples per symbol and axis on the modulator."""
_POSE_PLACES = 37
"""Every so many equations one that a pose is fitted to a displacement on."""
_POSE_STEPS = np.array([0.1, 0.1, 1e-4, 1e-4, 1e-4, 1e-4])
"""Of shift (pixels), scales and slopes, to see how a camera's pixels move with them."""


class CameraRelation:
    """Least squares of two frames against the fitted waves of the page that they show.

    Unknown are the page's illumination (a complex quadratic), the angle between the arms, and of each camera an affine
    displacement against its pose.

    Args:
        twin: ray tracer of the nominal device, for the cameras' poses.
        profile: the nominal device.
        parameters: [P] fitted; the pipe and the lenses are taken as they are.
        pair, references: frames of a known page, and reference-only frames.
        symbols: its unit phasors, complex [ny, nx].
    """

    def __init__(
        self,
        twin: Twin,
        profile: Profile,
        parameters: Real,
        pair: FramePair,
        references: FramePair,
        symbols: NDArray[np.complex128],
    ) -> None:
        self._twin, self._profile, self._start = twin, profile, parameters
        grid = field_grid(profile)
        self._pitch_px = grid.pitch_m / profile.camera.pitch_m
        waves = FittedWaves(profile, parameters, _SAMPLES, filled=True)
        page = on_modulator(np.angle(symbols), _SAMPLES)
        self._shown = np.stack(
            [waves.to_camera(page * term).astype(np.complex64) for term in illumination_terms(waves)]
        )
        x, y = np.meshgrid(grid.x_m, grid.y_m)
        self._places = np.stack([x, y], axis=-1)[::_STRIDE, ::_STRIDE]
        half = _INSIDE * np.array([profile.page_width_m, profile.page_height_m]) / 2
        self._inside = np.all(np.abs(self._places) < half, axis=-1)
        corner = profile.corner_m
        self._affine = np.stack([np.ones_like(x), x / corner, y / corner])[:, ::_STRIDE, ::_STRIDE]
        self._levels = [smooth_reference(frame) for frame in (references.in_phase, references.quadrature)]
        self._images = [
            ndimage.spline_filter((frame.astype(np.float32) - level) / (2 * level), order=3, output=np.float32)
            for frame, level in zip((pair.in_phase, pair.quadrature), self._levels, strict=True)
        ]

    def fit(self, turn: float) -> tuple[Real, float]:
        """Parameters [P] with the cameras where the page shows them, and the angle between the arms, radians.

        Args:
            turn: the angle to start from, good to some tens of degrees.
        """
        parameters = self._start.copy()
        illumination = np.zeros(len(self._shown), np.complex128)
        for number in range(_ROUNDS + 1):
            parameters, turn, illumination, moved = self._round(parameters, turn, illumination, poses=number > 0)
            if number > 0 and moved < _CONVERGED_PX:
                break
        return parameters, turn

    def _round(
        self, parameters: Real, turn: float, illumination: NDArray[np.complex128], *, poses: bool
    ) -> tuple[Real, float, NDArray[np.complex128], float]:
        """One Gauss-Newton step, of the illumination alone where not of `poses`; and how far it moved, pixels."""
        pixels = self._twin.pixels(parameters, self._places.reshape(-1, 2)).reshape(2, *self._inside.shape, 2)
        last = np.array(self._images[0].shape[::-1]) - 3
        chosen = self._inside & np.all((pixels > 2) & (pixels < last), axis=(0, 3))
        data = [_at(image, at[chosen], order=3) for image, at in zip(self._images, pixels, strict=True)]
        amplitude = np.sqrt(_at(self._levels[0], pixels[0][chosen], order=1))
        amplitude /= amplitude.mean()
        field = np.tensordot(illumination.astype(np.complex64), self._shown, 1)
        steps = np.gradient(field)
        here, down, across = (part[::_STRIDE, ::_STRIDE][chosen] / amplitude for part in (field, *steps))
        shown = self._shown[:, ::_STRIDE, ::_STRIDE][:, chosen] / amplitude
        affine = self._affine[:, chosen]
        columns, left = [], []
        for camera, arm in enumerate((0.0, turn)):
            phasor = np.exp(-1j * arm)
            weight = 1 / np.sqrt(np.abs(1 / phasor + here) ** 2 + READ_NOISE)
            along = (phasor + here.conj()) * weight  # derivative of Re(e exp(-i arm)) + |e|^2 / 2 by e
            left.append((data[camera] - (here * phasor).real - np.abs(here) ** 2 / 2) * weight)
            mine = [(along * term).real for term in shown] + [(along * 1j * term).real for term in shown]
            if poses:
                slopes = [(along * slope).real / self._pitch_px for slope in (across, down)]
                moves = [slope * term for slope in slopes for term in affine]
                still = [np.zeros_like(weight)] * len(moves)
                mine += [(here * phasor * -1j).real * weight * camera]
                mine += [*moves, *still] if camera == 0 else [*still, *moves]
            columns.append(np.stack(mine, axis=1))
        found = np.linalg.lstsq(np.concatenate(columns), np.concatenate(left), rcond=None)[0]
        terms = len(illumination)
        illumination = illumination + found[:terms] + 1j * found[terms : 2 * terms]
        if not poses:
            return parameters, turn, illumination, 0.0
        turn += float(found[2 * terms])
        largest = 0.0
        parameters = parameters.copy()
        for camera, name in enumerate(("in_phase", "quadrature")):
            move = found[2 * terms + 1 :].reshape(2, 2, 3)[camera]
            displacement = np.einsum("as,sn->na", move, affine)
            size = float(np.sqrt(np.mean(np.sum(displacement**2, axis=-1))))
            largest = max(largest, size)
            displacement *= min(1.0, _LARGEST_MOVE_PX / max(size, 1e-9))
            few = slice(None, None, _POSE_PLACES)
            parameters[indices(name)] += self._pose(parameters, camera, name, chosen, few, -displacement)
        return parameters, turn, illumination, largest

    def _pose(
        self, parameters: Real, camera: int, name: str, chosen: NDArray[np.bool_], few: slice, displacement: Real
    ) -> Real:
        """Change of a camera's pose that moves its pixels by `displacement`, [N, 2]."""
        places = self._places[chosen][few]
        here = self._twin.pixels(parameters, places)[camera]
        moved = []
        for index, step in zip(indices(name), _POSE_STEPS, strict=True):
            other = parameters.copy()
            other[index] += step
            moved.append(((self._twin.pixels(other, places)[camera] - here) / step).ravel())
        return np.asarray(np.linalg.lstsq(np.stack(moved, axis=1), displacement[few].ravel(), rcond=None)[0])


def _at(image: NDArray[np.float32], pixels: Real, order: Literal[1, 3]) -> Real:
    """Values at pixels [N, 2] (column, row)."""
    values = ndimage.map_coordinates(image, [pixels[:, 1], pixels[:, 0]], order=order, prefilter=False)
    return np.asarray(values, dtype=np.float64)
