"""The random bits are SplitMix64's, and the checksums have their catalogued check values."""

from __future__ import annotations

import binascii

import numpy as np
import pytest

from lightpage.codec.checksum import crc16, crc32c
from lightpage.codec.random_bits import random_bytes, random_order, random_words

ALL = (1 << 64) - 1


def split_mix(seed: int, count: int) -> list[int]:
    """As the paper has it: a state that grows by a constant, and is mixed."""
    state, out = seed, []
    for _ in range(count):
        state = (state + 0x9E3779B97F4A7C15) & ALL
        z = state
        z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & ALL
        z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & ALL
        out.append(z ^ (z >> 31))
    return out


@pytest.mark.parametrize("seed", [0, 1, 0x4C504844, 0xFFFFFFFF << 24 | 0xFFFFFF, ALL])
@pytest.mark.parametrize("count", [0, 1, 100])
def test_words_are_those_of_split_mix(seed: int, count: int) -> None:
    assert random_words(seed, count).tolist() == split_mix(seed, count)


def test_words_are_the_published_ones() -> None:
    # of seed 1234567, as Rosetta Code and others list them
    assert random_words(1234567, 5).tolist() == [
        6457827717110365317,
        3203168211198807973,
        9817491932198370423,
        4593380528125082431,
        16408922859458223821,
    ]


@pytest.mark.parametrize("count", [0, 1, 7, 8, 9, 17])
def test_bytes_are_the_words_with_the_lowest_byte_first(count: int) -> None:
    expected = b"".join(word.to_bytes(8, "little") for word in split_mix(99, 3))
    assert random_bytes(99, count).tobytes() == expected[:count]


def test_the_order_sorts_the_words() -> None:
    order, words = random_order(5, 1000), split_mix(5, 1000)
    assert sorted(order.tolist()) == list(range(1000))
    assert order.tolist() == sorted(range(1000), key=lambda index: words[index])


def crc_bit_by_bit(data: bytes, bits: int, polynomial: int, start: int) -> int:
    """A checksum whose bits are not reflected."""
    value = start
    for byte in data:
        value ^= byte << (bits - 8)
        for _ in range(8):
            value = value << 1 ^ (polynomial if value >> (bits - 1) & 1 else 0)
            value &= (1 << bits) - 1
    return value


def reflected(value: int, bits: int) -> int:
    return int(f"{value:0{bits}b}"[::-1], 2)


def test_checksums_have_their_check_values() -> None:
    assert crc16(b"123456789") == 0x29B1
    assert crc32c(b"123456789") == 0xE3069283
    assert crc32c(b"123456789") != binascii.crc32(b"123456789")


@pytest.mark.parametrize("length", [0, 1, 15, 64, 1000])
def test_checksums_are_those_of_their_polynomials(length: int) -> None:
    data = np.random.default_rng(length).bytes(length)
    assert crc16(data) == crc_bit_by_bit(data, 16, 0x1021, 0xFFFF)
    mirrored = bytes(reflected(byte, 8) for byte in data)
    assert crc32c(data) == reflected(crc_bit_by_bit(mirrored, 32, 0x1EDC6F41, 0xFFFFFFFF), 32) ^ 0xFFFFFFFF
