"""The page as symbols: levels, phases, and the sparse known pilots that every page carries."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lightpage.device.profile import Profile
from lightpage.errors import PageError
from lightpage.page.levels import Levels, check_levels

MIN_PILOTS = 4
"""Fewer cannot tell a page's piston from its shift."""

_POSITIONS, _VALUES = 0, 1
"""Independent random streams drawn from one pilot seed."""


def check_symbols(symbols: ArrayLike, page_shape: tuple[int, int], levels: int, subject: str) -> NDArray[np.uint8]:
    """Check one page of symbols [ny, nx] or several [page, ny, nx], and return them as uint8 of the same shape.

    Args:
        symbols: whole numbers from 0 to levels - 1.
        page_shape: (ny, nx).
        levels: M, 2 to 256.
        subject: name of the symbols, for the error message.

    Raises:
        PageError: wrong type, shape or range.
    """
    check_levels(levels, f"{subject}: levels")
    array = np.asarray(symbols)
    if array.dtype.kind not in "ui":
        raise PageError(subject, f"type {array.dtype}", "whole numbers")
    if array.ndim not in (2, 3) or array.shape[-2:] != tuple(page_shape):
        raise PageError(subject, f"shape {array.shape}", f"(..., {page_shape[0]}, {page_shape[1]})")
    if array.size and (int(array.min()) < 0 or int(array.max()) >= levels):
        raise PageError(subject, f"values from {array.min()} to {array.max()}", f"values from 0 to {levels - 1}")
    return array.astype(np.uint8, copy=False)


def symbol_phases(symbols: ArrayLike, levels: int | Levels) -> NDArray[np.float64]:
    """Phase of each symbol, radians, in the shape of `symbols`: 2 pi s / M, or that of uneven levels.

    Raises:
        PageError: a level count outside 2..256.
    """
    levels = Levels.of(levels)
    if levels.is_nominal:
        return np.asarray(symbols, dtype=np.float64) * (2 * np.pi / levels.count)
    return np.asarray(levels.phases[np.asarray(symbols)])


def pilot_mask(profile: Profile) -> NDArray[np.bool_]:
    """Default pilot positions, [ny, nx]: True where the symbol is known beforehand.

    One pilot in each cell of an even lattice, at a seeded random place within its cell, so that the pilots cover the
    page without sharing its period. Their number is about `page.pilot_fraction` of the symbols, and at least four
    where the page has that many.
    """
    ny, nx = profile.page_shape
    rows, columns = _lattice(ny, nx, profile.page.pilot_fraction)
    rng = np.random.default_rng([profile.page.pilot_seed, _POSITIONS])
    jitter = rng.random((2, rows, columns))
    row_edges = np.arange(rows + 1) * ny // rows
    column_edges = np.arange(columns + 1) * nx // columns
    y = row_edges[:-1, None] + (jitter[0] * np.diff(row_edges)[:, None]).astype(np.intp)
    x = column_edges[None, :-1] + (jitter[1] * np.diff(column_edges)[None, :]).astype(np.intp)
    mask = np.zeros((ny, nx), dtype=np.bool_)
    mask[y, x] = True
    return mask


def _lattice(ny: int, nx: int, fraction: float) -> tuple[int, int]:
    """Rows and columns of the lattice whose cells are nearest to square and whose count is near the wanted one."""
    count = min(max(MIN_PILOTS, round(fraction * ny * nx)), ny * nx)
    rows = min(max(1, round(float(np.sqrt(count * ny / nx)))), ny)
    columns = min(max(1, -(-count // rows)), nx)
    return min(max(rows, -(-count // columns)), ny), columns


def pilot_symbols(profile: Profile, levels: int) -> NDArray[np.uint8]:
    """The seeded pilot pattern floor(u M), u uniform in [0, 1), for the whole page [ny, nx].

    Only the values at the pilot positions mean anything; a full page of them lets positions be moved at will.

    Raises:
        PageError: a level count outside 2..256.
    """
    check_levels(levels)
    uniform = np.random.default_rng([profile.page.pilot_seed, _VALUES]).random(profile.page_shape)
    return np.floor(uniform * levels).astype(np.uint8)


def random_symbols(profile: Profile, levels: int, pages: int, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Pages of independent, uniform symbols with the pilots filled in, [page, ny, nx].

    Raises:
        PageError: a level count outside 2..256, or a negative page count.
    """
    check_levels(levels)
    if pages < 0:
        raise PageError("random pages", pages, "a count of at least 0")
    symbols = rng.integers(0, levels, size=(pages, *profile.page_shape), dtype=np.uint8)
    mask = pilot_mask(profile)
    symbols[:, mask] = pilot_symbols(profile, levels)[mask]
    return symbols
