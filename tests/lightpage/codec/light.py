"""Decoded pages drawn for tests: known symbols in von Mises noise, which is what a decoder's posterior claims."""

import numpy as np

from lightpage.codec.code import Code
from lightpage.codec.page_bytes import FileFacts, Header
from lightpage.codec.page_codec import PageCodec
from lightpage.page.levels import Levels
from lightpage.page.symbols import symbol_phases

SHAPE = (16, 24)
GROUP = FileFacts(5, 3, 0xFEDCBA98)


def pilot_mask(shape: tuple[int, int] = SHAPE) -> np.ndarray:
    """Draw pilots at one place in twenty, bool [ny, nx]."""
    return np.random.default_rng(5).random(shape) < 0.05


def codec_of(
    levels: int, coded: int, rate: int, corrections: int = 0, shape: tuple[int, int] = SHAPE, needed: float = 1.0
) -> PageCodec:
    code = Code(
        levels=levels, coded_bits=coded, rate_per_mille=rate, corrections=corrections, needed_information=needed
    )
    return PageCodec(code, pilot_mask(shape))


def header_of(codec: PageCodec, page: int = 3, volume: int = 0xFEDCBA98) -> Header:
    return Header(codec.code.id, volume, page, 1_000_000)


def written(codec: PageCodec, header: Header, rng: np.random.Generator) -> tuple[bytes, np.ndarray]:
    """User bytes and the symbols [ny, nx] of one page that holds them."""
    data = rng.integers(0, 256, (1, codec.user_bytes), np.uint8)
    levels = rng.integers(0, codec.code.levels, np.count_nonzero(codec.pilots), np.uint8)
    return data.tobytes(), codec.encode([header], data, GROUP, levels)[0]


def noisy(
    symbols: np.ndarray, levels: int | Levels, kappa: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Phases and concentrations of symbols in noise of concentration `kappa`, none where it is infinite."""
    phase = symbol_phases(symbols, levels)
    if np.isinf(kappa):
        return phase, np.full(phase.shape, 1e6)
    return phase + rng.vonmises(0, kappa, phase.shape), np.full(phase.shape, kappa)
