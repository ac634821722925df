"""Log-likelihood ratios of bits from the posterior of levels: in numpy, and by the compiled arithmetic bit for bit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lightpage.codec.compiled.choice import compiled, spread
from lightpage.codec.likelihood.arithmetic import LEAST_EXPONENT, Float32, exponential, logarithm
from lightpage.codec.likelihood.neighbours import LevelTable, Neighbours, Real

MOST_PHASE = 1e6
"""Radians, as the caller sees to."""
_CHUNK = 1 << 16
"""Weights at once: few enough for the cache."""
_TINY = np.finfo(np.float32).tiny


def ratios(phase: Real, concentration: Real, table: LevelTable, most: float, threads: int) -> Float32:
    """LLRs of label bits, float32 [symbols, b].

    Args:
        phase: radians, at most `MOST_PHASE`, [symbols].
        concentration: kappa, [symbols].
        table: table of the levels.
        most: LLRs are clipped here.
        threads: number of threads that share the work where it is compiled.
    """
    out = np.empty((len(phase), table.bits), np.float32)
    native = compiled()
    if native is None:
        _in_numpy(phase, concentration, table, most, out)
    else:
        spread(
            lambda some: native.llrs(phase[some], concentration[some], table.packed, most, out[some]),
            len(phase),
            threads,
        )
    return out


def _in_numpy(phase: Real, concentration: Real, table: LevelTable, most: float, out: Float32) -> None:
    place, away = _located(phase, table)
    square = away * away
    sine, cosine = (_polynomial(coefficients, square) for coefficients in table.series)
    along, across = concentration * cosine, concentration * (sine * away)
    is_near = concentration >= table.limit[0 if table.levels.is_nominal else place]
    for neighbours, which in ((table.near, is_near), (table.all, ~is_near)):
        chosen = np.flatnonzero(which)
        for start in range(0, len(chosen), size := max(1, _CHUNK // neighbours.width)):
            some = chosen[start : start + size]
            weights = _weights(neighbours, place[some], along[some], across[some])
            out[some] = _split(_by_coset(table, neighbours, place[some], weights), table.bits).T
    np.clip(out, -most, most, out=out)


def _located(phase: Real, table: LevelTable) -> tuple[NDArray[np.int64], Real]:
    """Place of the nearest level on the circle, and the phase's way from there, radians."""
    if table.levels.is_nominal:
        step = 2 * np.pi / table.levels.count
        nearest = np.rint(phase / step)
        return nearest.astype(np.int64) & (table.levels.count - 1), phase - nearest * step
    place = table.levels.places(phase)
    way = phase - table.levels.circle[place]
    return place, way - np.rint(way / (2 * np.pi)) * (2 * np.pi)


def _polynomial(coefficients: Real, x: Real) -> Real:
    total = np.full(x.shape, coefficients[-1])
    for c in coefficients[-2::-1]:
        total *= x
        total += c
    return total


def _weights(neighbours: Neighbours, place: NDArray[np.int64], along: Real, across: Real) -> Float32:
    """Posterior of the neighbours of phases over that of the nearest level, float32 [width, symbols]."""
    row = place if len(neighbours.cosine) > 1 else np.zeros(1, np.int64)
    exponent = along * neighbours.cosine[row].T
    exponent += across * neighbours.sine[row].T
    np.clip(exponent, LEAST_EXPONENT, 0, out=exponent)
    return exponential(exponent.astype(np.float32, order="C"))


def _by_coset(table: LevelTable, neighbours: Neighbours, place: NDArray[np.int64], weights: Float32) -> Float32:
    """Sums of weights by coset, [2^b, symbols]."""
    sums = np.zeros((table.cosets, len(place)), np.float32)
    if table.turn is None:
        coset, symbols = neighbours.coset[place].T, np.arange(len(place))
        for j, weight in enumerate(weights):
            sums[coset[j], symbols] += weight
        return sums
    few = min(neighbours.width, table.cosets)
    sums[:few] = weights[:few]
    for j in range(table.cosets, neighbours.width, table.cosets):
        sums += weights[j : j + table.cosets]
    first = place + table.turn - neighbours.width // 2
    turned = (np.arange(table.cosets)[:, None] - first) & (table.cosets - 1)
    return np.asarray(np.take_along_axis(sums, turned, axis=0))


def _split(sums: Float32, bits: int) -> Float32:
    """LLRs of label bits by the weights of cosets, [b, symbols].

    Bit k of a Gray label is 1 in the middle two of every four runs of 2^k cosets.
    """
    out = np.empty((bits, sums.shape[1]), np.float32)
    for k in range(bits):
        zero, one = np.zeros(sums.shape[1], np.float32), np.zeros(sums.shape[1], np.float32)
        for run, weight in enumerate(sums):
            total = one if (run >> 1 ^ run) & 1 else zero
            total += weight
        out[k] = logarithm(np.maximum(zero, _TINY)) - logarithm(np.maximum(one, _TINY))
        sums = sums[0::2] + sums[1::2]
    return out
