"""The random bits are SplitMix64's, and the checksums have their catalogued check values."""

from __future__ import annotations

import pytest

from lightpage.codec.checksum import Checksum, crc16, crc32c
from lightpage.codec.random_bits import random_bytes, random_order, random_words

PUBLISHED = [
    6457827717110365317,
    3203168211198807973,
    9817491932198370423,
    4593380528125082431,
    16408922859458223821,
]
"""Of seed 1234567, as Rosetta Code and others list them."""


def test_words_are_the_published_ones() -> None:
    assert random_words(1234567, 5).tolist() == PUBLISHED
    assert random_words(0, 1).tolist() == [0xE220A8397B1DCDAF]
    assert random_words((1 << 64) - 1, 2).tolist() == [0xE4D971771B652C20, 0xE99FF867DBF682C9]
    assert random_words(5, 0).size == 0


@pytest.mark.parametrize("count", [0, 1, 7, 8, 9, 17])
def test_bytes_are_the_words_with_the_lowest_byte_first(count: int) -> None:
    expected = b"".join(word.to_bytes(8, "little") for word in PUBLISHED)
    assert random_bytes(1234567, count).tobytes() == expected[:count]


def test_the_order_sorts_the_words() -> None:
    order, words = random_order(5, 1000), random_words(5, 1000)
    assert order.tolist() == sorted(range(1000), key=lambda index: words[index])


def test_checksums_have_their_check_values() -> None:
    assert crc16(b"123456789") == 0x29B1
    assert crc32c(b"123456789") == 0xE3069283
    assert crc32c(b"") == 0
    parts = Checksum()
    for part in (b"1234", b"", b"56789"):
        parts.add(part)
    assert parts.value == 0xE3069283
