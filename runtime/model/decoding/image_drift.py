"""Reads the image's drift from decoded phases, applies it to the tables, and looks for an image that is lost.

Moved light is demodulated with the wrong phase, symbol by symbol.

Drift is the vector (shift x, shift y, tilt x, tilt y): of the image on both cameras, camera pixels, and of the signal
against the reference, radians at the right and lower edge of the page's image. A reference beam that stays where it is
while the image moves over it shows as a tilt, for its wavefront is curved.
"""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from lightpage.calibration.coherence import branch_shares
from lightpage.calibration.image_search import FoundImage, ImageSearch
from lightpage.calibration.interfaces import BRANCHES, Twin
from lightpage.calibration.parameters import NAMES
from lightpage.calibration.phases import tilt_of_shift
from lightpage.calibration.sampling_table import APART, SamplingTable, sampling_table, shifted, symbol_centres
from lightpage.device.profile import Profile
from lightpage.errors import BundleError, FrameError
from lightpage.page.correction import wrapped
from lightpage.page.levels import Levels
from lightpage.page.pilots import Pilots, read_pilots
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.page import Inference
from lightpage.runtime.model.execution.estimator_graph import EstimatorGraph

Real = NDArray[np.float64]

SHIFT, TILT = slice(0, 2), slice(2, 4)
"""Parts of a drift vector."""

PROBE_PX = 0.25
"""Half of the shift over which the sensitivity is read: linear there, and far above the arithmetic's noise."""

SMOOTHING = 5
"""Side of the median filter over the sensitivity, symbols: another page shows the same map to a few percent (their
correlation rises from 0.95 to 0.995), and the zones' borders stay sharp."""

LEAST_COHERENCE = 0.6
"""Agreement of the pilots below which a page says nothing of drift: pilots that are not this page's give 0.2, a
decoder that is lost hardly more."""

SAFE_DEVIATIONS = 2.5
"""A decision serves like a pilot where the nearest wrong one lies this many standard deviations away."""

_MOST_SYMBOLS = 10_000
"""Symbols beside the pilots from which drift is read, at most: they show shift to some thousandths of a pixel on a page
of any size, and pages of the same device wait for each other's drift."""

_CAP = 1500.0
"""Largest concentration that counts as such: no symbol shall outvote the rest."""

_OUTLIER = 3.0
"""Residual in standard deviations from which a symbol's weight falls."""

_MOST_OVER_CLAIM = 3.0
"""Variance that decisions may leave over what pilots alone leave; decisions among too few levels leave far more."""

_ROUNDS = 3

MEASURED_INFLATION = 4.0
"""Factor on the covariance of a drift that an estimator measures, for what its diagonal information leaves out."""


@dataclass(frozen=True)
class Estimate:
    """A drift with what is known of it.

    Attributes:
        drift: [4], see the module.
        covariance: [4, 4].
        constant_rad: phase common to all symbols.
        over_claim: variance of what the drift leaves of the phases over what their concentrations promise, at least 1.
    """

    drift: Real
    covariance: Real
    constant_rad: float
    over_claim: float = 1.0

    @property
    def deviations(self) -> Real:
        """Standard deviations, [4]."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def gained_nats(self, prior: Real) -> float:
        """Return the nats that a fit gains by chance: the log volume of drifts in `prior` [4, 4] over that left."""
        return max(0.0, float(np.linalg.slogdet(prior)[1] - np.linalg.slogdet(self.covariance)[1]) / 2)


class DriftModel:
    """A linear model of the change that drift makes to decoded phases.

    Args:
        slopes: change of each symbol's decoded phase with the image's drift, [4, ny, nx], radians a unit of drift;
            or the promise of it.
        covariance: covariance of the drift that an estimator has measured, [4, 4]; None for a graph that measures none,
            of which the decoded phases show all drift.
    """

    def __init__(self, slopes: Real | Future[Real], covariance: Real | None = None) -> None:
        self._measured, self._covariance = slopes, covariance

    @property
    def slopes(self) -> Real:
        """See the constructor; waits for it if it is still being measured."""
        return self._measured.result() if isinstance(self._measured, Future) else self._measured

    @classmethod
    def of_decoder(cls, decoder: Decoder, twin: Twin) -> DriftModel:
        """Measure the slopes on a thread of its own: a service is ready before that ends, and its first page waits.

        Args:
            decoder: decoder of a bundle.
            twin: twin of that bundle.

        Raises:
            CalibrationError: the bundle holds no calibration.
        """
        graph = decoder.graph
        if isinstance(graph, EstimatorGraph):
            # relative gain, tilt and shift, to shift and tilt
            order = [3, 4, 1, 2]
            covariance = MEASURED_INFLATION * graph.value("nuisance_covariance").astype(np.float64)
            return cls(graph.value("responses")[order].astype(np.float64), covariance[np.ix_(order, order)])
        parameters = decoder.bundle.calibration.vector
        thread = ThreadPoolExecutor(1, thread_name_prefix="lightpage-drift")
        slopes = thread.submit(drift_slopes, decoder, twin, parameters)
        thread.shutdown(wait=False)
        return cls(slopes)

    def unexplained(self, inference: Inference, untraced: Real) -> tuple[Inference, Real]:
        """A page freed from the drift that its table does not hold, so far as that is known.

        Args:
            inference: what the graph says of the page.
            untraced: known drift that is not in the table, [4].

        Returns:
            The page with phases that show only what is not known, and the drift that the graph has measured beyond
            what is known, [4]; zero where it measures none.
        """
        if inference.drift is None:
            return inference.turned(-self.phase_change(untraced)), np.zeros(4)
        return inference, inference.drift - untraced

    def phase_change(self, drift: Real) -> Real:
        """Return what `drift` [4] adds to decoded phases [ny, nx], radians, first order."""
        return np.asarray(np.tensordot(drift, self.slopes, 1))

    def estimate(self, inference: Inference, levels: int | Levels, pilots: Pilots, prior: Real) -> Estimate | None:
        """Drift that a page still shows, from its pilots and then from safe decisions too; None where pilots disagree.

        The 54 pilots of a bench page show shift to 0.01 px per axis; with the safe decisions of 16 levels it is 0.005.

        Args:
            inference: what the graph says of the page.
            levels: M, or uneven levels.
            pilots: its known symbols.
            prior: covariance [4, 4] of the drift about zero before the page was seen.
        """
        prior = prior if self._covariance is None else self._covariance
        known = np.zeros(pilots.mask.shape)
        known[pilots.mask] = pilots.phases
        taken = np.flatnonzero(pilots.mask | _lattice(pilots.mask.shape))
        at, known, slopes = pilots.mask.ravel()[taken], known.ravel()[taken], self.slopes.reshape(4, -1)[:, taken]
        levels, concentration = Levels.of(levels), inference.concentration.ravel()[taken].astype(np.float64)
        phase = inference.phase.ravel()[taken] - read_pilots(inference.p, pilots).piston.angle_rad
        residual, weight = wrapped(phase[at] - known[at]), np.minimum(concentration[at], _CAP)
        if not weight.sum() > 0 or abs(np.sum(weight * np.exp(1j * residual))) < LEAST_COHERENCE * weight.sum():
            return None
        coarse = _solve(residual, slopes[:, at], weight, prior)
        if coarse is None:
            return None
        concentration /= coarse.over_claim
        freed = phase - coarse.constant_rad - np.tensordot(coarse.drift, slopes, 1)
        safe = SAFE_DEVIATIONS / np.sqrt(np.maximum(concentration, 1e-9)) < levels.half_way(freed)
        decided = levels.nearest_phases(freed)
        decided[at] = known[at]
        chosen = safe | at
        weight = np.minimum(concentration[chosen], _CAP)
        fine = _solve(wrapped(phase - decided)[chosen], slopes[:, chosen], weight, prior)
        # a page of more levels than it is read with is decided wrongly throughout
        return coarse if fine is None or fine.over_claim > _MOST_OVER_CLAIM else fine


def _lattice(shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Places evenly over a page, `_MOST_SYMBOLS` or fewer, bool [ny, nx]; all of them where they are no more."""
    every = int(np.ceil(np.sqrt(np.prod(shape) / _MOST_SYMBOLS)))
    lattice = np.zeros(shape, bool)
    lattice[every // 2 :: every, every // 2 :: every] = True
    return lattice


def drift_slopes(decoder: Decoder, twin: Twin, parameters: Real, pair: FramePair | None = None) -> Real:
    """Change of each symbol's decoded phase with drift, [4, ny, nx], radians a unit of drift.

    What shift does shows on a page, with four runs of the graph; what tilt does follows from the twin.

    Args:
        decoder: decoder of a bundle.
        twin, parameters: twin and parameters of its device.
        pair: a page that it reads; the golden page by default.

    Raises:
        FrameError: the page is refused when its image is looked for a little off its place.
        BundleError: the golden page is.
    """
    registration, given = decoder.graph.value("registration"), pair is not None
    profile, pair = decoder.bundle.profile, decoder.bundle.golden.pair if pair is None else pair

    def phase(shift_px: Real) -> NDArray[np.float32]:
        try:
            table = {"registration": shifted(registration, shift_px)}
            return decoder.infer(pair, table, doubtful=given, alone=True).phase
        except FrameError as error:
            kind, page = (FrameError, "page") if given else (BundleError, f"{decoder.bundle.subject}: golden page")
            raise kind(f"{page}, moved by {PROBE_PX} px", error.got, error.expected) from None

    moved = [[phase(sign * PROBE_PX * axis) for sign in (1, -1)] for axis in np.eye(2)]
    by_table = [np.angle(np.exp(1j * (plus - minus))) / (2 * PROBE_PX) for plus, minus in moved]
    by_shift = [-scipy.ndimage.median_filter(slope, SMOOTHING).astype(np.float64) for slope in by_table]
    return np.stack([*by_shift, *tilt_slopes(twin, parameters, profile)])


def tilt_slopes(twin: Twin, parameters: Real, profile: Profile) -> Real:
    """Change of each symbol's decoded phase with a tilt of the signal against the reference, [2, ny, nx].

    A tilt adds phase where light lands, and a symbol's light lands in one place along each branch: their mean, weighted
    by the power that goes there.

    Args:
        twin, parameters: the device.
        profile: the nominal device.
    """
    rays = twin.trace(parameters, symbol_centres(profile))
    power = branch_shares(rays.positions, BRANCHES) ** 2
    middle = np.sum(power[..., None] * rays.places, axis=0) / np.maximum(power.sum(axis=0), 1e-12)[:, None]
    edges = np.array([profile.page_width_m, profile.page_height_m]) / 2
    return np.asarray((middle / edges).T.reshape(2, *profile.page_shape))


def _solve(residual: Real, slopes: Real, weight: Real, prior: Real) -> Estimate | None:
    """Robust weighted least squares of residual = constant + slopes . drift; weights are inverse variances."""
    columns = np.concatenate([np.ones((1, len(residual))), slopes]).T
    precision = np.zeros((5, 5))
    precision[1:, 1:] = np.linalg.inv(prior)
    trusted: Real = weight
    off: Real = residual
    solution: Real = np.zeros(5)
    for _ in range(_ROUNDS):
        # a network that is too sure of itself shows in the residual
        excess = max(1.0, float(np.sum(trusted * off**2) / len(off))) if solution.any() else 1.0
        normal = columns.T @ (columns * trusted[:, None]) / excess + precision
        if not np.isfinite(normal).all():
            return None
        solution = np.asarray(
            np.linalg.solve(normal, columns.T @ (trusted * (off + columns @ solution)) / excess), np.float64
        )
        off = wrapped(residual - columns @ solution)
        trusted = weight / (1 + off**2 * weight / _OUTLIER**2)
    excess = max(1.0, float(np.sum(trusted * off**2) / len(off)))
    covariance: Real = np.linalg.inv(columns.T @ (columns * trusted[:, None]) / excess + precision).astype(np.float64)
    return Estimate(solution[1:], covariance[1:, 1:], float(solution[0]), excess)


class BundleTables:
    """The tables of a bundle's device under drift.

    Args:
        decoder: decoder of the bundle as it is.
        twin: twin of the bundle.

    Raises:
        CalibrationError: the bundle holds no calibration.
    """

    def __init__(self, decoder: Decoder, twin: Twin) -> None:
        self._decoder, self._twin, self._calibration = decoder, twin, decoder.bundle.calibration
        self._registration = decoder.graph.value("registration")

    def shifted(self, shift_px: Real) -> SamplingTable:
        """Tensors to feed for an image `shift_px` (x, y) from where calibration saw it; empty for no shift."""
        return {"registration": shifted(self._registration, shift_px)} if np.any(shift_px) else {}

    def tilt_of(self, shift_px: Real) -> Real:
        """Tilt (x, y) of the signal against a reference that stays while the image shifts, radians."""
        profile = self._decoder.bundle.profile
        half = profile.page_width_m / 2, profile.page_height_m / 2
        return tilt_of_shift(self._calibration.parameters, shift_px * profile.image_pixel_m, *half)

    def traced(self, tilt_rad: Real) -> Decoder:
        """The decoder with the table of a device whose signal is tilted so against the reference."""
        bundle = self._decoder.bundle
        parameters = self._calibration.vector.copy()
        for name, tilt in zip(("camera_tilt_x_rad", "camera_tilt_y_rad"), tilt_rad, strict=True):
            parameters[NAMES.index(name)] += tilt
        table = sampling_table(self._twin, parameters, self._calibration.turn_rad, bundle.profile)
        return self._decoder.with_table(self._decoder.taken(table))


class BundleSearch:
    """The search for the image of a page of one bundle's device; calls come from many threads.

    Args:
        decoder: decoder of the bundle; its field graph, references and angle between the arms are used.
        twin: twin of the bundle.

    Raises:
        CalibrationError: the bundle holds no calibration.
    """

    def __init__(self, decoder: Decoder, twin: Twin) -> None:
        self._decoder, self._references = decoder, decoder.references
        self._registration, self._homodyne = (decoder.graph.value(name) for name in ("registration", "homodyne"))
        self._apart = {name: decoder.graph.value(name) for name in APART if name in decoder.graph.ports}
        self._search = ImageSearch(twin, decoder.bundle.calibration.vector, decoder.bundle.profile)

    def find(
        self, pair: FramePair, pilots: Pilots, around_px: Real | None = None, references: FramePair | None = None
    ) -> FoundImage:
        """Look for the image of a page within reach of all of `around_px`.

        Args:
            pair, pilots: pair and pilots of the page.
            around_px: [K, 2], shifts (x, y) in camera pixels against calibration; by default where that saw the image.
            references: reference-only frames taken with the page, if not those that the decoder decodes with.

        Raises:
            BundleError: no graph of the bundle shows the field.
        """
        references = references or self._references
        field, _ = self._decoder.field_solver(pair, references, self._registration, self._homodyne, self._apart)
        return self._search.find(field, pilots, around_px)
