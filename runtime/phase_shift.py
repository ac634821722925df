"""Reads the image's shift from decoded phases: moved light is demodulated with the wrong phase, symbol by symbol."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from optics.pilots import Pilots
from optics.registration.table import registration_coefficients, shifted
from runtime.bundle import Table
from runtime.calibrated import calibration_of
from runtime.decoder import DecodedPage, Decoder
from runtime.twin import OnnxTwin

Real = NDArray[np.float64]

PROBE_PX = 0.25
"""Half of the shift over which the sensitivity is read: linear there, and far above the arithmetic's noise."""

SMOOTHING = 5
"""Side of the median filter over the sensitivity, symbols: another page shows the same map to a few percent (their
correlation rises from 0.95 to 0.995), and the zones' borders stay sharp."""

LEAST_COHERENCE = 0.6
"""Agreement of the pilots below which a page says nothing of shift: pilots that are not this page's give 0.2, a
decoder that is lost hardly more."""

SAFE_DEVIATIONS = 2.5
"""A decision serves like a pilot where the nearest wrong one lies this many standard deviations away."""

LARGEST_ERROR_PX = 0.15
"""Standard deviation of the estimate, per axis, above which a page is left out unless its shift is plain to see."""

PLAIN_DEVIATIONS = 4.0
"""A shift of so many standard deviations is there, however large they are: the further off a page is, the less exactly
it says by how much, until it has been decoded where it lies."""

_CAP = 400.0
"""Largest concentration that counts as such: no symbol shall outvote the rest."""

_OUTLIER = 3.0
"""Residual in standard deviations from which a symbol's weight falls."""

_ROUNDS = 3


@dataclass(frozen=True)
class Estimate:
    """A shift with what is known of it.

    Attributes:
        shift_px: (x, y), camera pixels.
        error_px: standard deviation per axis.
        constant_rad: phase common to all symbols.
    """

    shift_px: Real
    error_px: Real
    constant_rad: float


class PhaseShift:
    """Measures the remaining shift of decoded pages and moves the table by a total shift.

    Args:
        registration: the table's registration without shift, float32 [2, 2, 10].
        sensitivity: change of each symbol's decoded phase with a shift along x and y, [2, ny, nx], radians a camera
            pixel.
        pilots: the known symbols of pages of M levels that come without their own.
    """

    def __init__(self, registration: NDArray[np.float32], sensitivity: Real, pilots: Callable[[int], Pilots]) -> None:
        self._registration, self._sensitivity, self._pilots = registration, sensitivity, pilots

    @classmethod
    def of_decoder(cls, decoder: Decoder) -> PhaseShift:
        """Find the sensitivity on the golden page, with four decodes.

        Raises:
            BundleError: the twin cannot be traced.
            CalibrationError: the bundle holds no calibration.
        """
        registration = default_registration(decoder)
        pair = decoder.bundle.golden.pair
        moved = [
            [decoder.infer(pair, _moved(registration, sign * PROBE_PX * axis)).phase for sign in (1, -1)]
            for axis in np.eye(2)
        ]
        slopes = [np.angle(np.exp(1j * (plus - minus))) / (2 * PROBE_PX) for plus, minus in moved]
        smooth = np.stack([ndimage.median_filter(slope, SMOOTHING) for slope in slopes])
        return cls(registration, smooth.astype(np.float64), decoder.pilots)

    def move(self, shift_px: Real) -> Table:
        """The table of an image that lies `shift_px` (x, y) from where calibration saw it."""
        return _moved(self._registration, shift_px) if np.any(shift_px) else {}

    def measure(self, page: DecodedPage, pilots: Pilots | None = None) -> Estimate | None:
        """Remaining shift of a page, or None where it does not show it reliably."""
        estimate = self.estimate(page, pilots)
        if estimate is None:
            return None
        plain = np.linalg.norm(estimate.shift_px / estimate.error_px) > PLAIN_DEVIATIONS
        return estimate if plain or np.all(estimate.error_px <= LARGEST_ERROR_PX) else None

    def bend(self, shift_px: Real) -> Real:
        """What to add to the phases [ny, nx] of a page that was decoded `shift_px` (x, y) off, radians, first order."""
        return np.asarray(np.tensordot(shift_px, self._sensitivity, 1))

    def estimate(self, page: DecodedPage, pilots: Pilots | None = None) -> Estimate | None:
        """Shift from the pilots, then, freed from it, from safe decisions too; None where the pilots disagree.

        A page of the bench device has 54 pilots: 0.03 px per axis. With the safe decisions of 16 levels it is 0.005.
        `pilots` are the page's known symbols where they differ from the device's.
        """
        pilots = self._pilots(page.levels) if pilots is None else pilots
        residual = _wrapped(page.phase[pilots.mask] - pilots.phases)
        weight = np.minimum(page.concentration[pilots.mask], _CAP).astype(np.float64)
        if not weight.sum() > 0 or abs(np.sum(weight * np.exp(1j * residual))) < LEAST_COHERENCE * weight.sum():
            return None
        coarse = _solve(residual, self._sensitivity[:, pilots.mask], weight)
        if coarse is None:
            return None
        freed = page.phase - self._model(coarse)
        spread = SAFE_DEVIATIONS / np.sqrt(np.maximum(page.concentration, 1e-9))
        safe = (spread < np.pi / page.levels) & ~pilots.mask
        step = 2 * np.pi / page.levels
        decided = np.rint(freed / step) * step
        decided[pilots.mask] = pilots.phases
        chosen = safe | pilots.mask
        return _solve(
            _wrapped(page.phase - decided)[chosen],
            self._sensitivity[:, chosen],
            np.minimum(page.concentration[chosen], _CAP).astype(np.float64),
        )

    def _model(self, estimate: Estimate) -> Real:
        """Phase error of every symbol under an estimate, radians [ny, nx]."""
        return estimate.constant_rad - self.bend(estimate.shift_px)


def default_registration(decoder: Decoder) -> NDArray[np.float32]:
    """The registration that a decode takes where none is fed: the bundle's re-fitted one, else its calibration's."""
    bundle = decoder.bundle
    if (kept := bundle.table.get("registration")) is not None:
        return kept
    return registration_coefficients(OnnxTwin(bundle, 1), calibration_of(bundle).vector, bundle.profile)


def _moved(registration: NDArray[np.float32], shift_px: Real) -> Table:
    return {"registration": shifted(registration, shift_px)}


def _solve(residual: Real, sensitivity: Real, weight: Real) -> Estimate | None:
    """Robust weighted least squares of residual = constant - sensitivity . shift; weights are inverse variances."""
    if len(residual) < 4:
        return None
    columns = np.stack([np.ones_like(residual), -sensitivity[0], -sensitivity[1]], axis=1)
    trusted = weight
    solution, off = np.zeros(3), residual
    for _ in range(_ROUNDS):
        normal = columns.T @ (columns * trusted[:, None])
        if not np.linalg.cond(normal) < 1e10:
            return None
        solution = solution + np.linalg.solve(normal, columns.T @ (trusted * off))
        off = _wrapped(residual - columns @ solution)
        trusted = weight / (1 + off**2 * weight / _OUTLIER**2)
    # a network that is too sure of itself shows in the residual
    excess = max(1.0, float(np.sum(trusted * off**2) / len(off)))
    error = np.sqrt(np.diag(np.linalg.inv(columns.T @ (columns * trusted[:, None]))) * excess)
    return Estimate(solution[1:], error[1:], float(solution[0]))


def _wrapped(angle: Real) -> Real:
    return np.asarray(angle - 2 * np.pi * np.rint(angle / (2 * np.pi)))
