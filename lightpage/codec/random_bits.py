"""The one source of fixed random bits on a page: SplitMix64, which any language makes in a few lines.

Output i (from 0) of a seed is mix(seed + (i + 1) * G) in arithmetic modulo 2^64 (Steele, Lea, Flood: Fast splittable
pseudorandom number generators, OOPSLA 2014).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_GAMMA = np.uint64(0x9E3779B97F4A7C15)
_MULTIPLIERS = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)


def random_words(seed: int, count: int) -> NDArray[np.uint64]:
    """The first `count` outputs of a seed of at most 64 bits."""
    with np.errstate(over="ignore"):
        z = np.uint64(seed) + np.arange(1, count + 1, dtype=np.uint64) * _GAMMA
        z = (z ^ (z >> np.uint64(30))) * _MULTIPLIERS[0]
        z = (z ^ (z >> np.uint64(27))) * _MULTIPLIERS[1]
        return np.asarray(z ^ (z >> np.uint64(31)))


def random_bytes(seed: int, count: int) -> NDArray[np.uint8]:
    """`count` bytes: the outputs of a seed, each with its lowest byte first."""
    return random_words(seed, -(-count // 8)).astype("<u8").view(np.uint8)[:count]


def random_order(seed: int, count: int) -> NDArray[np.intp]:
    """The numbers 0 to count - 1 in the ascending order of their outputs; of two equal ones the lower number first."""
    return np.argsort(random_words(seed, count), kind="stable")
