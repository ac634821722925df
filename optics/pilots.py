"""What pilots show: the piston, which frames alone do not, and how far a decoder's claims may be believed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from optics.errors import PageError
from optics.page import pilot_mask, pilot_symbols, symbol_phases
from optics.profile import Profile

_BELIEF = 20.0
"""Pilots that count for the decoder before any is seen: noise of 54 pilots then costs under 0.01 bit a symbol."""


@dataclass(frozen=True)
class Pilots:
    """Known symbols of a page.

    Attributes:
        mask: where they are, bool [ny, nx].
        phases: what they are, radians, one a True in `mask` in row order.
    """

    mask: NDArray[np.bool_]
    phases: NDArray[np.float64]

    def __post_init__(self) -> None:
        """Check that there is one phase a pilot.

        Raises:
            PageError: no pilots, or another number of phases.
        """
        count = int(np.count_nonzero(self.mask))
        if count == 0 or self.phases.shape != (count,):
            raise PageError("pilots", f"{count} positions and phases of shape {self.phases.shape}", "one phase each")

    @classmethod
    def of_profile(cls, profile: Profile, levels: int, mask: NDArray[np.bool_] | None = None) -> Pilots:
        """The seeded pattern of `profile` for pages of `levels` levels, at `mask` or at its default positions."""
        where = pilot_mask(profile) if mask is None else mask
        return cls.of_symbols(where, pilot_symbols(profile, levels), levels)

    @classmethod
    def of_symbols(cls, mask: NDArray[np.bool_], symbols: NDArray[np.uint8], levels: int) -> Pilots:
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
        angle_rad: to be taken off every decoded phase, -pi..pi.
        coherence: 1 where all pilots agree on it, near 1/sqrt(number of pilots) where they say nothing.
    """

    angle_rad: float
    coherence: float


def estimate_piston(p: NDArray[np.floating], pilots: Pilots) -> Piston:
    """Piston of a page from its pilots, each weighted by its concentration.

    angle of sum (px + i py) exp(-i theta) over the pilots, theta their known phase.

    Args:
        p: (px, py), [2, ny, nx].
        pilots: the known symbols of this page.

    Raises:
        PageError: the page has another shape than the pilots.
    """
    if p.shape[1:] != pilots.mask.shape:
        raise PageError("pilot positions", f"shape {pilots.mask.shape}", f"shape {p.shape[1:]}, as the page has")
    at_pilots = p[0][pilots.mask].astype(np.float64) + 1j * p[1][pilots.mask]
    total = np.sum(at_pilots * np.exp(-1j * pilots.phases))
    weight = float(np.abs(at_pilots).sum())
    return Piston(float(np.angle(total)), float(abs(total) / weight) if weight > 0 else 0.0)


def remove_piston(phase: NDArray[np.floating], angle_rad: float) -> NDArray[np.float32]:
    """`phase` less the piston, wrapped to -pi..pi, float32, same shape."""
    turned = phase.astype(np.float64) - angle_rad
    return np.asarray(turned - 2 * np.pi * np.rint(turned / (2 * np.pi)), np.float32)


def estimate_trust(p: NDArray[np.floating], pilots: Pilots, angle_rad: float) -> float:
    """Factor on the claimed concentrations that the pilots bear out, 0 to 1.

    Twice kappa (1 - cos error), summed over n pilots whose piston they gave themselves, is about n - 1 where the claims
    are true. A device that has drifted shows more; the pilots are then most likely under claims that are smaller by as
    much. The decoder starts with the credit of `_BELIEF` pilots, and gets no more than it claims.

    Args:
        p: (px, py), [2, ny, nx].
        pilots: the known symbols of this page.
        angle_rad: the page's piston, as `estimate_piston` found it.
    """
    x, y = p[0][pilots.mask].astype(np.float64), p[1][pilots.mask].astype(np.float64)
    told = pilots.phases + angle_rad
    missed = 2 * float(np.sum(np.hypot(x, y) - x * np.cos(told) - y * np.sin(told)))
    return min(1.0, (_BELIEF + len(told) - 1) / (_BELIEF + missed))
