"""Coherence of a geometry with a known page: a number between 0 and 1, 1 where the geometry explains the page."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.interfaces import BRANCHES, Twin
from lightpage.calibration.patches import Sampler
from lightpage.calibration.sampling_table import symbol_centres
from lightpage.device.profile import Profile

Real = NDArray[np.float64]

COHERENT_BRANCHES = ("direct", "x", "y")
"""Branches that geometry is judged by; the mixed ones bias the pipe's angle."""

_SAMPLES = 3


def page_coherence(
    sampler: Sampler, twin: Twin, parameters: Real, profile: Profile, symbols: NDArray[np.complexfloating]
) -> float:
    """Coherence of the demodulated branches with the known symbols over the whole page.

    |sum w z conj(s)| / sqrt(sum |w s|^2 sum |z|^2) over symbols and branches, with z the light of a branch demodulated
    by the twin's phase and averaged over the symbol, s the symbol's light and w the share of the beam that leaves
    through the branch's cell (a triangle in the exit centroid).

    Args:
        sampler: the recovered field.
        twin, parameters: the geometry to judge.
        profile: the nominal device.
        symbols: light that the modulator makes of them, complex [ny, nx].
    """
    centres = symbol_centres(profile)
    steps = ((np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5) * profile.symbol_pitch_m
    light = np.zeros((len(COHERENT_BRANCHES), len(centres)), dtype=complex)
    positions = np.empty(0)
    chosen = [BRANCHES.index(name) for name in COHERENT_BRANCHES]
    for dx in steps:
        for dy in steps:
            rays = twin.trace(parameters, centres + np.array([dx, dy]), centres)
            light += sampler(rays.places[chosen]) * np.exp(-1j * rays.phases[chosen])
            positions = rays.positions
    shares = branch_shares(positions)
    expected = shares * symbols.ravel()
    total = np.sum(light * np.conj(expected))
    norm = np.sqrt(np.sum(np.abs(expected) ** 2) * np.sum(np.abs(light) ** 2))
    return float(abs(total) / max(norm, 1e-30))


def branch_shares(positions: Real, branches: Sequence[str] = COHERENT_BRANCHES) -> Real:
    """Share of each branch in a symbol's light, to first order: a triangle in the exit centroid per axis.

    Args:
        positions: exit centroid over the pipe's width, (x, y') last, [N, 2].
        branches: names out of `BRANCHES`; the two mixed ones are given half of their light each.

    Returns:
        [branches, N]; those of all of `BRANCHES` add up to one.
    """
    even = np.clip(1 - np.abs(positions - 2 * np.round(positions / 2)), 0, 1)
    odd = np.clip(1 - np.abs(positions - (2 * np.floor(positions / 2) + 1)), 0, 1)
    shares = []
    for name in branches:
        share = (odd if "x" in name else even)[:, 0] * (odd if "y" in name else even)[:, 1]
        shares.append(share / 2 if name in ("xy", "yx") else share)
    return np.stack(shares)


def seen_share(twin: Twin, parameters: Real, profile: Profile) -> Real:
    """Share of each symbol's light that lands on both cameras, by rays, [ny, nx].

    Args:
        twin, parameters: the device.
        profile: the nominal device.
    """
    rays = twin.trace(parameters, symbol_centres(profile))
    shares = branch_shares(rays.positions, BRANCHES)
    size = np.array([profile.camera.columns_px, profile.camera.rows_px])
    seen = np.zeros(shares.shape[1])
    for share, places in zip(shares, rays.places, strict=True):
        pixels = twin.pixels(parameters, places)
        seen += share * np.all((pixels > -0.5) & (pixels < size - 0.5), axis=(0, 2))
    return seen.reshape(profile.page_shape)
