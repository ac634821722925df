"""Reed-Solomon words: the library's parity bit for bit, t wrong symbols mended, no more."""

import numpy as np
import pytest
import reedsolo

from lightpage.codec.reed_solomon import LONGEST_WORD, parity, repair


def library(corrections: int) -> reedsolo.RSCodec:
    return reedsolo.RSCodec(2 * corrections, nsize=4095, c_exp=12, prim=0x1053)


def random_word(data: int, corrections: int, seed: int) -> np.ndarray:
    symbols = np.random.default_rng(seed).integers(0, 4096, (1, data))
    return np.concatenate([symbols, parity(symbols, corrections)], axis=1)[0]


@pytest.mark.parametrize(("data", "corrections"), [(1, 1), (2, 32), (100, 7), (LONGEST_WORD - 8, 4)])
def test_parity_is_the_librarys(data: int, corrections: int) -> None:
    rng = np.random.default_rng([data, corrections])
    symbols = rng.integers(0, 4096, (3, data))
    symbols[1] = 0
    symbols[2, rng.random(data) < 0.5] = 0
    got = parity(symbols, corrections)
    assert got.shape == (3, 2 * corrections)
    for row, ends in zip(symbols, got, strict=True):
        assert list(library(corrections).encode(row.tolist())) == [*row, *ends]


def spoil(word: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """A copy with `count` symbols changed to others."""
    spoilt = word.copy()
    where = rng.choice(len(word), count, replace=False)
    spoilt[where] ^= rng.integers(1, 4096, count)
    return spoilt


@pytest.mark.parametrize(("data", "corrections"), [(1, 1), (30, 1), (30, 4), (200, 8), (60, 32)])
def test_up_to_t_wrong_symbols_are_mended_wherever_they_are(data: int, corrections: int) -> None:
    rng = np.random.default_rng([data, corrections])
    for trial in range(5):
        word = random_word(data, corrections, trial)
        for count in {0, 1, corrections // 2, corrections}:
            found = repair(spoil(word, count, rng), corrections)
            assert found is not None
            assert np.array_equal(found[0], word[:data])
            assert found[1] == count


@pytest.mark.parametrize(("data", "corrections"), [(30, 4), (200, 8), (60, 32)])
def test_more_wrong_symbols_are_noticed(data: int, corrections: int) -> None:
    # a wrong repair needs another word within t symbols: 1 in t! x (4095 / length)^t, 1 in 7 x 10^9 at most
    rng = np.random.default_rng([data, corrections])
    for trial in range(5):
        word = random_word(data, corrections, trial)
        for count in (corrections + 1, corrections + 2, 2 * corrections, len(word)):
            assert repair(spoil(word, count, rng), corrections) is None
