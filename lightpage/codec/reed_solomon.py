"""Reed-Solomon words over GF(2^12) that mend what the inner code leaves: few symbols of a page decided wrongly.

The field's polynomial is x^12 + x^6 + x^4 + x + 1 (0x1053), its generator is 2, and the roots of a word of t
corrections are 2^0 to 2^(2t - 1). Encoding adds up the parity of words with a single 1, by logarithms; decoding, which
few pages need, is the library's.
"""

from __future__ import annotations

import threading
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

Symbols = NDArray[np.int64]

SYMBOL_BITS = 12
LONGEST_WORD = (1 << SYMBOL_BITS) - 1
POLYNOMIAL = 0x1053

_LIBRARY = threading.Lock()
"""Guards the library, whose tables are global: they are made anew with every number of corrections."""


@lru_cache(1)
def _tables() -> tuple[Symbols, Symbols]:
    """Powers of the generator, twice over, and logarithms; that of 0 is not to be used."""
    powers, logarithms = np.zeros(2 * LONGEST_WORD, np.int64), np.zeros(LONGEST_WORD + 1, np.int64)
    value = 1
    for exponent in range(LONGEST_WORD):
        powers[exponent], logarithms[value] = value, exponent
        value <<= 1
        value ^= POLYNOMIAL if value > LONGEST_WORD else 0
    powers[LONGEST_WORD:] = powers[:LONGEST_WORD]
    return powers, logarithms


@lru_cache(8)
def _unit_parity(data: int, corrections: int) -> Symbols:
    """Logarithms of the parity of words with a single 1, [data, 2 t]: x^(data - 1 - i + 2 t) modulo the generator."""
    powers, logarithms = _tables()
    roots = 2 * corrections
    generator = np.array([1], np.int64)  # highest power first
    for root in range(roots):
        shifted = np.append(generator, 0)
        shifted[1:] ^= powers[logarithms[generator] + root]
        generator = shifted
    log_generator = logarithms[generator[1:]]
    remainders = np.zeros((data, roots), np.int64)
    remainder = generator[1:].copy()
    for row in range(data - 1, -1, -1):
        remainders[row] = remainder
        lead, remainder = remainder[0], np.append(remainder[1:], 0)
        if lead:
            remainder ^= powers[log_generator + logarithms[lead]]
    return logarithms[remainders]  # no remainder of a power of x has a zero while the word is shorter than the field


def parity(data: Symbols, corrections: int) -> Symbols:
    """Parity of words.

    Args:
        data: 12-bit symbols, the first is the highest power, [words, data].
        corrections: t, symbols of a word that can be mended.

    Returns:
        [words, 2 t].
    """
    powers, logarithms = _tables()
    logs = _unit_parity(data.shape[1], corrections)
    out = np.empty((len(data), 2 * corrections), np.int64)
    for word, row in enumerate(data):
        terms = np.where(row[:, None] == 0, 0, powers[logarithms[row][:, None] + logs])
        out[word] = np.bitwise_xor.reduce(terms, axis=0)
    return out


@lru_cache(8)
def _library(corrections: int) -> Any:
    import reedsolo

    return reedsolo.RSCodec(2 * corrections, nsize=LONGEST_WORD, c_exp=SYMBOL_BITS, prim=POLYNOMIAL)


def repair(word: Symbols, corrections: int) -> tuple[Symbols, int] | None:
    """The data of a word with parity, mended, and how many symbols were wrong; None where they are too many.

    Args:
        word: data and then parity, [symbols].
        corrections: t.
    """
    import reedsolo

    symbols = [int(symbol) for symbol in word]
    with _LIBRARY:
        try:
            mended, _, wrong = _library(corrections).decode(symbols)
        except reedsolo.ReedSolomonError:
            return None
    return np.array(mended, np.int64), len(wrong)
