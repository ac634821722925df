"""Headers: what is written is read, damage is noticed, what does not fit is refused."""

from dataclasses import replace

import numpy as np
import pytest

from lightpage.codec.header import (
    FIELD_BYTES,
    HEADER_BYTES,
    MOST_BYTES,
    MOST_PAGES,
    check_volume,
    decode_header,
    encode_headers,
    header_levels,
    header_symbols,
    parse_header,
)
from lightpage.codec.page_bytes import Header
from tests.lightpage.codec.light import noisy
from tests.lightpage.refused import refused

HEADER = Header(0x1234, 0xFEDCBA98, 0x0A0B0C, 0x0102030405)
ALL_LEVELS = [2, 4, 8, 16, 32, 64, 128, 256]
EXTREMES = [HEADER, Header(0, 0, 0, 0), Header(0xFFFF, 0xFFFFFFFF, MOST_PAGES - 1, MOST_BYTES)]


def test_the_bytes_are_the_documented_ones() -> None:
    assert HEADER.fields() == bytes.fromhex("01 1234 fedcba98 0a0b0c 0102030405")
    assert len(HEADER.fields()) == FIELD_BYTES
    for header in EXTREMES:
        assert len(header.to_bytes()) == HEADER_BYTES
        assert header.to_bytes()[:FIELD_BYTES] == header.fields()
        assert parse_header(header.to_bytes()) == header


def test_each_changed_byte_and_another_version_are_noticed() -> None:
    assert parse_header(replace(HEADER, version=2).to_bytes()) is None
    text = HEADER.to_bytes()
    for place in range(HEADER_BYTES):
        for change in (1, 6, 128, 255):
            damaged = bytearray(text)
            damaged[place] ^= change
            assert parse_header(bytes(damaged)) is None


@pytest.mark.parametrize(
    ("subject", "got", "volume"),
    [
        ("volume id", -1, (-1, 0, 1)),
        ("volume id", 1 << 32, (1 << 32, 0, 1)),
        ("file", -1, (0, -1, 1)),
        ("file", MOST_BYTES + 1, (0, MOST_BYTES + 1, 1)),
        ("file", MOST_PAGES + 1, (0, 0, MOST_PAGES + 1)),
    ],
)
def test_what_does_not_fit_a_header_is_refused(subject: str, got: int, volume: tuple[int, int, int]) -> None:
    check_volume((1 << 32) - 1, MOST_BYTES, MOST_PAGES)
    with refused(subject, got):
        check_volume(*volume)


@pytest.mark.parametrize("levels", ALL_LEVELS)
class TestOnAPage:
    def test_it_uses_every_eighth_level(self, levels: int) -> None:
        symbols = encode_headers(EXTREMES, levels)
        bits = {2: 1, 4: 1, 8: 1, 16: 1, 32: 2, 64: 3, 128: 4, 256: 5}[levels]
        assert header_levels(levels) == 1 << bits
        assert header_symbols(levels) == -(-(408 if levels <= 4 else 204) // bits)
        assert symbols.shape == (len(EXTREMES), header_symbols(levels))
        assert symbols.dtype == np.uint8
        assert not (symbols % (levels // header_levels(levels))).any()
        assert int(symbols.max()) < levels

    def test_it_comes_back_through_noise(self, levels: int) -> None:
        # 3.5 deviations to the middle between its levels, two of them where they are but two
        kappa = max(1.5, (3.5 / (np.pi / header_levels(levels))) ** 2)
        rng = np.random.default_rng(levels)
        for header, symbols in zip(EXTREMES, encode_headers(EXTREMES, levels), strict=True):
            for noise in (np.inf, kappa, kappa):
                assert decode_header(*noisy(symbols, levels, noise, rng), levels) == header

    @pytest.mark.parametrize("kappa", [0.0, 1.0, 1e6])
    def test_noise_is_no_header(self, levels: int, kappa: float) -> None:
        rng = np.random.default_rng(levels)
        for _ in range(4):
            phase = rng.uniform(-np.pi, np.pi, header_symbols(levels))
            assert decode_header(phase, np.full(phase.shape, kappa), levels) is None
