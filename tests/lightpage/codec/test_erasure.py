"""Parity pages: what is lost comes back, whichever pages they are, and one more loss is noticed."""

import itertools

import numpy as np
import pytest

from lightpage.codec.erasure import check_group, parity_of, restore
from tests.lightpage.refused import refused


def product(a: int, b: int) -> int:
    """Multiply in GF(2^8) with polynomial 0x11D."""
    out = 0
    while b:
        out ^= a if b & 1 else 0
        a = a << 1 ^ (0x11D if a & 0x80 else 0)
        b >>= 1
    return out


INVERSE = {a: next(b for b in range(256) if product(a, b) == 1) for a in range(1, 256)}


def group_of(data_pages: int, parity_pages: int, size: int, seed: int = 0) -> tuple[list[bytes], dict[int, bytes]]:
    """Data pages, and all pages of their group by place."""
    rng = np.random.default_rng([data_pages, parity_pages, seed])
    data = [rng.bytes(size) for _ in range(data_pages)]
    return data, dict(enumerate(data + parity_of(data, parity_pages)))


@pytest.mark.parametrize(("data_pages", "parity_pages"), [(1, 1), (1, 4), (5, 3), (20, 6), (61, 3), (250, 5)])
@pytest.mark.parametrize("size", [1, 3])
def test_parity_is_the_documented_sum(data_pages: int, parity_pages: int, size: int) -> None:
    data, pages = group_of(data_pages, parity_pages, size)
    for i in range(parity_pages):
        expected = bytearray(size)
        for j, page in enumerate(data):
            for place, byte in enumerate(page):
                expected[place] ^= product(byte, INVERSE[(data_pages + i) ^ j])
        assert pages[data_pages + i] == bytes(expected)


@pytest.mark.parametrize(
    ("data_pages", "parity_pages", "patterns"), [(5, 3, 60), (20, 6, 60), (61, 3, 60), (247, 8, 10)]
)
def test_any_losses_as_many_as_parity_pages_come_back(data_pages: int, parity_pages: int, patterns: int) -> None:
    """Losses of one page more do not come back, unless all lost pages are parity."""
    data, pages = group_of(data_pages, parity_pages, 37)
    rng = np.random.default_rng(0)
    for _ in range(30):
        lost = rng.choice(len(pages), parity_pages + 1, replace=False)
        left = {place: page for place, page in pages.items() if place not in lost[1:]}
        assert restore(left, data_pages, parity_pages) == data
        del left[lost[0]]
        assert (restore(left, data_pages, parity_pages) is None) == bool((lost < data_pages).any())


def test_every_pattern_of_a_small_group_comes_back() -> None:
    data, pages = group_of(5, 3, 10)
    for count in range(9):
        for kept in itertools.combinations(pages, count):
            found = restore({place: pages[place] for place in reversed(kept)}, 5, 3)
            assert found == (data if count >= 5 or set(kept) >= set(range(5)) else None)


@pytest.mark.parametrize("group", [(0, 3), (-1, 2), (5, -1), (250, 6), (256, 0)])
def test_groups_that_cannot_be_are_refused(group: tuple[int, int]) -> None:
    for call in (lambda: check_group(*group), lambda: restore({}, *group)):
        with refused("group of pages", f"{group[0]} data and {group[1]} parity"):
            call()
