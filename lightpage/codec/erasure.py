"""Parity pages: any k of the k + m pages of a group give all of its data back.

A systematic Reed-Solomon code over GF(2^8) with polynomial 0x11D, byte by byte across the pages: parity page i of a
group is the sum over its data pages j of data[j] / ((k + i) xor j), a Cauchy matrix.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import InvalidInputError

MOST_GROUP_PAGES = 255
_POLYNOMIAL = 0x11D

_Bytes = NDArray[np.uint8]


def check_group(data_pages: int, parity_pages: int) -> None:
    """Check the size of a group.

    Raises:
        InvalidInputError: no data page, or more pages than the field has elements.
    """
    if not (data_pages >= 1 and parity_pages >= 0 and data_pages + parity_pages <= MOST_GROUP_PAGES):
        raise InvalidInputError(
            "group of pages",
            f"{data_pages} data and {parity_pages} parity pages",
            f"at least 1 and at least 0, {MOST_GROUP_PAGES} at most in all",
        )


def parity_of(data: list[bytes], parity_pages: int) -> list[bytes]:
    """Parity of a group's data pages, all of one length.

    Args:
        data: k pages.
        parity_pages: m.
    """
    check_group(len(data), parity_pages)
    if parity_pages == 0:
        return []
    coefficients = _coefficients(range(parity_pages), range(len(data)), len(data))
    parity = [np.zeros(len(data[0]), np.uint8) for _ in range(parity_pages)]
    _add(parity, coefficients, [np.frombuffer(page, np.uint8) for page in data])
    return [page.tobytes() for page in parity]


def restore(pages: Mapping[int, bytes], data_pages: int, parity_pages: int) -> list[bytes] | None:
    """All data pages of a group from those that are left; None where they are too few.

    Args:
        pages: remaining pages, by place in the group: data 0 to k - 1, parity k to k + m - 1; all of one length.
        data_pages: k.
        parity_pages: m.
    """
    check_group(data_pages, parity_pages)
    if all(place in pages for place in range(data_pages)):
        return [pages[place] for place in range(data_pages)]
    if len(pages) < data_pages or parity_pages == 0:
        return None
    found = {place: np.frombuffer(page, np.uint8) for place, page in pages.items()}
    lost = [place for place in range(data_pages) if place not in found]
    known = [place for place in range(data_pages) if place in found]
    parity = [place for place in found if place >= data_pages][: len(lost)]
    rows = [place - data_pages for place in parity]
    of_lost = [found[place].copy() for place in parity]
    _add(of_lost, _coefficients(rows, known, data_pages), [found[place] for place in known])
    restored = [np.zeros_like(page) for page in of_lost]
    _add(restored, _inverse(_coefficients(rows, lost, data_pages)), of_lost)
    return [pages[place] if place in pages else restored[lost.index(place)].tobytes() for place in range(data_pages)]


@cache
def _products() -> _Bytes:
    """Return the products of all pairs of elements of the field, [256, 256]."""
    powers, logarithms, power = np.empty(510, np.uint8), np.zeros(256, np.intp), 1
    for exponent in range(255):
        powers[exponent] = powers[exponent + 255] = power
        logarithms[power] = exponent
        power = power << 1 ^ (_POLYNOMIAL if power & 0x80 else 0)
    products: _Bytes = powers[logarithms[:, None] + logarithms]
    products[0] = products[:, 0] = 0
    return products


def _coefficients(parity: Sequence[int], data: Sequence[int], data_pages: int) -> _Bytes:
    """Return the coefficients of data pages in parity pages, [parity, data]."""
    inverses = np.argmax(_products() == 1, axis=1).astype(np.uint8)
    matrix: _Bytes = inverses[(data_pages + np.array(parity, np.intp))[:, None] ^ np.array(data, np.intp)]
    return matrix


def _add(sums: Sequence[_Bytes], coefficients: _Bytes, pages: Sequence[_Bytes]) -> None:
    """Add pages to sums, each times the coefficient of its column in the row of the sum."""
    for total, row in zip(sums, coefficients, strict=True):
        for coefficient, page in zip(row, pages, strict=True):
            total ^= _products()[coefficient][page]


def _inverse(matrix: _Bytes) -> _Bytes:
    """Return the inverse of a square part of the Cauchy matrix; all parts have one, so no pivot is zero."""
    size, products = len(matrix), _products()
    work = np.concatenate([matrix, np.eye(size, dtype=np.uint8)], axis=1)
    for place in range(size):
        work[place] = products[np.argmax(products[work[place, place]] == 1)][work[place]]
        factors = work[:, place].copy()
        factors[place] = 0
        work ^= products[factors[:, None], work[place]]
    return work[:, size:]
