"""Parity pages: any k of the k + m pages of a group give all of its data back.

A systematic Reed-Solomon code over GF(2^8) with polynomial 0x11D, byte by byte across the pages: parity page i of a
group is the sum over its data pages j of data[j] / ((k + i) xor j), a Cauchy matrix.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

from lightpage.errors import InvalidInputError

_FRAGMENT_HEADER = 80
"""Bytes that the library puts before each fragment. They follow from the sizes and stay off the page."""
MOST_GROUP_PAGES = 255


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


@lru_cache(8)
def _coder(data_pages: int, parity_pages: int) -> Any:
    from pyeclib.ec_iface import ECDriver

    # not isa_l_rs_vand, which cannot restore some patterns of as many losses as there are parity pages
    return ECDriver(k=data_pages, m=parity_pages, ec_type="isa_l_rs_cauchy")


def parity_of(data: list[bytes], parity_pages: int) -> list[bytes]:
    """Parity of a group's data pages, all of one length.

    Args:
        data: k pages.
        parity_pages: m.
    """
    check_group(len(data), parity_pages)
    if parity_pages == 0:
        return []
    fragments = _coder(len(data), parity_pages).encode(b"".join(data))
    return [fragment[_FRAGMENT_HEADER:][: len(data[0])] for fragment in fragments[len(data) :]]


@lru_cache(8)
def _fragment_headers(data_pages: int, parity_pages: int, size: int) -> tuple[bytes, ...]:
    fragments = _coder(data_pages, parity_pages).encode(bytes(data_pages * size))
    return tuple(fragment[:_FRAGMENT_HEADER] for fragment in fragments)


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
    size = len(next(iter(pages.values())))
    headers = _fragment_headers(data_pages, parity_pages, size)
    whole = _coder(data_pages, parity_pages).decode([headers[place] + page for place, page in pages.items()])
    return [whole[start : start + size] for start in range(0, data_pages * size, size)]
