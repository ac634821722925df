"""Evidence of pilots: the piston, which frames alone do not show, and how far a decoder's claims may be trusted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import hyp1f1, i0e

from lightpage.device.profile import Profile
from lightpage.errors import PageError
from lightpage.page.levels import Levels
from lightpage.page.symbols import pilot_mask, pilot_symbols, symbol_phases
from lightpage.von_mises import information, mean_resultant
from lightpage.words import brief, sides

_OVER_CLAIM_ODDS = 0.3
"""Odds that claims are too large by a given factor, for each e-fold of the factor, over that they are right, before any
pilot is read."""
_LEAST_MISSED = 1e-6
"""Least error of the pilots over what their claims allow: less is rounding."""

_OUTLIERS = 0.01
"""Share of pilots that are expected to say nothing: a dead place of the modulator, a value that was not written."""
_MOST_OUTLIERS = 0.05
"""Largest share of outliers; where more pilots contradict the rest, the device has changed, and all of them count."""
_ROUNDS = 10
_MEDIAN_CHI2 = 0.4549
"""Median of the chi-squared distribution with one degree of freedom."""

LEAST_CONFIRMED_SHARE = 0.25
"""Share of the claimed information that the pilots of a page must confirm. A page whose image lies a pixel off confirms
a third on the bench device, four pixels off a thirtieth, a page of another device nothing."""

LEAST_CONFIRMED_NATS = 9.0
"""Information that all pilots together must confirm, beyond what fitting to them gains. Chance confirms as much at
most about once in e^9 = 8,000 pages."""

SOUND_SHARE = 0.85
"""Share below which a device is no longer as it was calibrated, where the pilots' own noise does not explain it."""

_NOISE_DEVIATIONS = 3.0
"""Standard deviations of the pilots' noise that are allowed for before a device is said to have changed."""
_CHANCE = 2.0
"""Times its variance that a stroke's squared error must be beyond, and by which it is drawn to zero."""
_NOTHING = 1e-9
"""Below it a sum of weights, or a mean square of radians, is rounding."""


@dataclass(frozen=True, repr=False)
class Pilots:
    """Known symbols of a page.

    Attributes:
        mask: mask of the pilots, bool [ny, nx].
        phases: phases of the pilots, radians, one a True in `mask` in row order.
    """

    mask: NDArray[np.bool_]
    phases: NDArray[np.float64]

    def __repr__(self) -> str:
        return brief(self, f"{self.phases.size} of {sides(self.mask.shape)} symbols")

    def __post_init__(self) -> None:
        """Check that there is one phase a pilot.

        Raises:
            PageError: no pilots, or another number of phases.
        """
        count = int(np.count_nonzero(self.mask))
        if count == 0:
            raise PageError("pilots", "none", "at least one position")
        if self.phases.shape != (count,):
            raise PageError("pilots", f"{count} positions and phases of shape {self.phases.shape}", "one phase each")

    @classmethod
    def of_profile(cls, profile: Profile, levels: int | Levels, mask: NDArray[np.bool_] | None = None) -> Pilots:
        """The seeded pattern of `profile` for pages of `levels` levels, at `mask` or at its default positions."""
        where = pilot_mask(profile) if mask is None else mask
        return cls.of_symbols(where, pilot_symbols(profile, Levels.of(levels).count), levels)

    @classmethod
    def of_symbols(cls, mask: NDArray[np.bool_], symbols: NDArray[np.uint8], levels: int | Levels) -> Pilots:
        """Pilots whose values stand in a page of known symbols [ny, nx].

        Raises:
            PageError: mask and page differ in shape.
        """
        if mask.shape != symbols.shape:
            raise PageError("pilot positions", f"shape {mask.shape}", f"shape {symbols.shape}, as the page has")
        return cls(mask, symbol_phases(symbols[mask], levels))


@dataclass(frozen=True)
class Piston:
    """The common phase of a page.

    Attributes:
        angle_rad: angle to be taken off every decoded phase, -pi..pi.
        coherence: 1 where all pilots agree on it, near 1/sqrt(number of pilots) where they say nothing.
    """

    angle_rad: float
    coherence: float


@dataclass(frozen=True)
class PilotCheck:
    """Check of a decoder by its pilots: the information that it claims of them, and how much of that they confirm.

    Attributes:
        pilots: how many were looked at.
        claimed_bits: information per pilot that the concentrations claim, as the decoder states them.
        confirmed_bits: information per pilot that the known phases show, the claims scaled by the trust that they
            deserve: log2 of the density at the true phase over that of no knowledge.
        noise_bits: standard deviation of `confirmed_bits` where the claims are true.
        gained_nats: gain by chance from fitting the piston, and drift where it was read, to the same pilots.
    """

    pilots: int
    claimed_bits: float
    confirmed_bits: float
    noise_bits: float
    gained_nats: float

    @property
    def share(self) -> float:
        """Confirmed over claimed information, 0 where nothing is claimed or confirmed."""
        return max(0.0, self.confirmed_bits) / self.claimed_bits if self.claimed_bits > 0 else 0.0

    @property
    def agrees(self) -> bool:
        """Return whether the pilots confirm a large enough share of the claimed information."""
        return self.share >= LEAST_CONFIRMED_SHARE

    @property
    def tells(self) -> bool:
        """Return whether the pilots confirm more information than chance would."""
        nats = self.confirmed_bits * np.log(2) * self.pilots
        return bool(nats >= LEAST_CONFIRMED_NATS + self.gained_nats)

    @property
    def confirmed(self) -> bool:
        """Return whether the pilots confirm the page, so that it may be given out."""
        return self.agrees and self.tells

    @property
    def sound(self) -> bool:
        """Return whether this page's pilots are consistent with the device as the decoder knows it."""
        return self.confirmed_bits >= SOUND_SHARE * self.claimed_bits - _NOISE_DEVIATIONS * self.noise_bits

    @property
    def recalibration_due(self) -> bool:
        """Return whether the device has changed so far that a recalibration pays."""
        return not self.sound


def estimate_piston(p: NDArray[np.floating], pilots: Pilots) -> Piston:
    """Piston of a page from its pilots, each weighted by its concentration.

    angle of sum (px + i py) exp(-i theta) over the pilots, theta their known phase.

    Args:
        p: (px, py), [2, ny, nx].
        pilots: the known symbols of this page.

    Raises:
        PageError: the page has another shape than the pilots.
    """
    errors = _errors(p, pilots)
    total, weight = np.sum(errors), float(np.abs(errors).sum())
    return Piston(float(np.angle(total)), float(abs(total) / weight) if weight > 0 else 0.0)


def remove_piston(phase: NDArray[np.floating], angle_rad: float | NDArray[np.floating]) -> NDArray[np.float32]:
    """`phase` less the piston, or less an angle a symbol, wrapped to -pi..pi, float32, same shape."""
    turned = phase.astype(np.float64) - angle_rad
    return np.asarray(turned - 2 * np.pi * np.rint(turned / (2 * np.pi)), np.float32)


def estimate_trust(p: NDArray[np.floating], pilots: Pilots, angle_rad: float) -> float:
    """Factor on the claimed concentrations that the pilots bear out, 0 to 1.

    Twice kappa (1 - cos error), summed over n pilots whose piston they gave themselves, is about n - 1 where the claims
    are true. A device that has drifted shows more. The factor is the posterior mean of claims that are either right, or
    too large by a factor whose logarithm has an even density (`_OVER_CLAIM_ODDS`). Thus chance takes little from right
    claims, and wrong ones are taken back in full.

    Args:
        p: (px, py), [2, ny, nx].
        pilots: the known symbols of this page, those left out that are outliers.
        angle_rad: the page's piston, as `estimate_piston` found it.

    Raises:
        PageError: the page has another shape than the pilots.
    """
    missed = _missed(_errors(p, pilots), angle_rad)
    if len(missed) < 2:
        return 1.0
    shape = (len(missed) - 1) / 2
    rate = max(float(missed.sum()) / 2, _LEAST_MISSED * shape)
    with np.errstate(over="ignore"):
        # integral of t^(shape - 1) exp(rate (1 - t)) over factors t from 0 to 1
        over_right = hyp1f1(1, shape + 1, rate) / shape
    right = 1 / (1 + _OVER_CLAIM_ODDS * over_right)
    if_wrong = (shape - 1 / over_right) / rate
    return float(right + (1 - right) * if_wrong)


def check_claims(
    p: NDArray[np.floating], pilots: Pilots, angle_rad: float, trust: float, gained_nats: float = 0.0
) -> PilotCheck:
    """Hold what a decoder claims of its pilots against what they are.

    The piston is fitted to the same pilots: with their concentrations' sum K, chance gains log(2 pi K) / 2 nats by it,
    the width of what it may be over that of what is left.

    Args:
        p: (px, py), [2, ny, nx].
        pilots: the known symbols of this page, those left out that are outliers.
        angle_rad: the page's piston, as `estimate_piston` found it.
        trust: factor on the concentrations, as `estimate_trust` found it.
        gained_nats: the same of whatever else was fitted to these pilots.

    Raises:
        PageError: the page has another shape than the pilots.
    """
    errors = _errors(p, pilots)
    kappa, count = np.abs(errors), len(errors)
    mean = mean_resultant(kappa)
    claimed = information(kappa)
    confirmed = -trust * _missed(errors, angle_rad) / 2 - np.log(i0e(trust * kappa))
    # of kappa cos(error): kappa^2 (E cos^2 - (E cos)^2), with E cos^2 = 1 - I1 / (kappa I0)
    variance = kappa * np.maximum(kappa * (1 - mean**2) - mean, 0)
    by_piston = max(0.0, float(np.log(max(2 * np.pi * trust * kappa.sum(), 1.0))) / 2)
    return PilotCheck(
        pilots=count,
        claimed_bits=float(claimed.mean() / np.log(2)),
        confirmed_bits=float(confirmed.mean() / np.log(2)),
        noise_bits=float(np.sqrt(variance.sum()) / count / np.log(2)),
        gained_nats=by_piston + gained_nats,
    )


def without_outliers(p: NDArray[np.floating], pilots: Pilots) -> Pilots:
    """The pilots less those few that contradict all others, as a dead place of the modulator does.

    A pilot is left out where its error is more likely one of any size, `_OUTLIERS` of all pilots having such, than what
    the concentration claimed there allows after the others have told how far claims may be trusted.

    Args:
        p: (px, py), [2, ny, nx].
        pilots: the known symbols of this page.

    Raises:
        PageError: the page has another shape than the pilots.
    """
    errors = _errors(p, pilots)
    kappa, sound = np.abs(errors), np.ones(len(errors), bool)
    for iteration in range(_ROUNDS):
        missed = _missed(errors, float(np.angle(errors[sound].sum())))
        over_claim = float(np.mean(missed[sound]) if iteration else np.median(missed) / _MEDIAN_CHI2)
        trust = 1 / max(1.0, over_claim)
        odds = np.log((1 - _OUTLIERS) / _OUTLIERS) - np.log(i0e(trust * kappa)) - trust * missed / 2
        before, sound = sound, odds > 0
        if np.array_equal(before, sound) or not sound.any():
            break
    if np.count_nonzero(~sound) > _MOST_OUTLIERS * len(sound):
        return pilots
    mask = pilots.mask.copy()
    mask[pilots.mask] = sound
    return Pilots(mask, pilots.phases[sound])


@dataclass(frozen=True)
class PilotReading:
    """Reading of a page's pilots.

    Attributes:
        piston: common phase of the page.
        trust: factor on the claimed concentrations, 0..1.
        check: claims of the decoder, and the part that the pilots confirm.
        sound: the pilots that were read.
    """

    piston: Piston
    trust: float
    check: PilotCheck
    sound: Pilots


def read_pilots(p: NDArray[np.floating], pilots: Pilots, gained_nats: float = 0.0) -> PilotReading:
    """Read a page's pilots, those few left out that contradict all others.

    Args:
        p: (px, py), [2, ny, nx].
        pilots: the known symbols of this page.
        gained_nats: see `check_claims`.

    Raises:
        PageError: the page has another shape than the pilots.
    """
    sound = without_outliers(p, pilots)
    piston = estimate_piston(p, sound)
    trust = estimate_trust(p, sound, piston.angle_rad)
    return PilotReading(piston, trust, check_claims(p, sound, piston.angle_rad, trust, gained_nats), sound)


@dataclass(frozen=True)
class StrokeError:
    """Error of the modulator's phase stroke on a page: drift, or flicker.

    Attributes:
        relative: as the pilots show it; NaN where they have but one phase.
        deviation: its standard deviation; infinite where pilots tell nothing.
    """

    relative: float
    deviation: float

    def of_phases(self, phase: NDArray[np.floating]) -> NDArray[np.float32]:
        """Phase that it adds to each symbol, radians [ny, nx]: to be taken off. What chance may show is left."""
        chance = _CHANCE * self.deviation**2
        if not self.relative**2 > chance:
            return np.zeros(phase.shape, np.float32)
        likely = self.relative - chance / self.relative
        return np.asarray(likely * (np.mod(phase, 2 * np.pi) - np.pi), np.float32)


def stroke_error(phase: NDArray[np.floating], concentration: NDArray[np.floating], pilots: Pilots) -> StrokeError:
    """Measure the stroke's error: a slope over the pilots' phases.

    Args:
        phase: radians, piston and smooth error removed, [ny, nx].
        concentration: von Mises kappa, [ny, nx].
        pilots: the known symbols of this page, those left out that are outliers.
    """
    weight = concentration[pilots.mask].astype(np.float64)
    error = remove_piston(phase[pilots.mask], pilots.phases)
    away = pilots.phases - np.sum(weight * pilots.phases) / max(float(weight.sum()), _NOTHING)
    spread = float(np.sum(weight * away**2))
    if not spread > _NOTHING * weight.sum():
        return StrokeError(np.nan, np.inf)
    return StrokeError(float(np.sum(weight * away * error)) / spread, spread**-0.5)


def _errors(p: NDArray[np.floating], pilots: Pilots) -> NDArray[np.complex128]:
    """Estimates at the pilots, kappa exp(i error), complex [pilots], piston and all."""
    if p.shape[1:] != pilots.mask.shape:
        raise PageError("pilot positions", f"shape {pilots.mask.shape}", f"shape {p.shape[1:]}, as the page has")
    at_pilots = p[0][pilots.mask].astype(np.float64) + 1j * p[1][pilots.mask]
    return np.asarray(at_pilots * np.exp(-1j * pilots.phases), np.complex128)


def _missed(errors: NDArray[np.complex128], angle_rad: float) -> NDArray[np.float64]:
    """Return 2 kappa (1 - cos error) of each pilot, piston removed: chi-squared of one degree where claims are true."""
    return np.asarray(2 * (np.abs(errors) - (errors * np.exp(-1j * angle_rad)).real), np.float64)
