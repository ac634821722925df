"""Headers: what is written is read, damage is noticed, what does not fit is refused."""

from __future__ import annotations

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
from lightpage.errors import InvalidInputError
from tests.lightpage.codec.light import noisy

HEADER = Header(0x1234, 0xFEDCBA98, 0x0A0B0C, 0x0102030405)
ALL_LEVELS = [2, 4, 8, 16, 32, 64, 128, 256]
EXTREMES = [
    HEADER,
    Header(0, 0, 0, 0),
    Header(0xFFFF, 0xFFFFFFFF, MOST_PAGES - 1, MOST_BYTES),
]


def test_the_bytes_are_the_documented_ones() -> None:
    assert HEADER.fields() == bytes.fromhex("01 1234 fedcba98 0a0b0c 0102030405")
    assert len(HEADER.fields()) == FIELD_BYTES
    assert len(HEADER.to_bytes()) == HEADER_BYTES
    assert HEADER.to_bytes()[:FIELD_BYTES] == HEADER.fields()


@pytest.mark.parametrize("header", EXTREMES)
def test_what_is_written_is_read(header: Header) -> None:
    assert parse_header(header.to_bytes()) == header


def test_each_changed_byte_is_noticed() -> None:
    text = HEADER.to_bytes()
    for place in range(HEADER_BYTES):
        for change in range(1, 256):
            damaged = bytearray(text)
            damaged[place] ^= change
            assert parse_header(bytes(damaged)) is None


@pytest.mark.parametrize("version", [0, 2, 255])
def test_another_version_is_not_read(version: int) -> None:
    assert parse_header(replace(HEADER, version=version).to_bytes()) is None


@pytest.mark.parametrize("volume", [-1, 1 << 32])
def test_a_volume_id_that_does_not_fit_is_refused(volume: int) -> None:
    with pytest.raises(InvalidInputError, match=f"volume id: got {volume}, wanted 0 to 4294967295"):
        check_volume(volume, 0, 1)


@pytest.mark.parametrize("size", [-1, MOST_BYTES + 1])
def test_a_file_size_that_does_not_fit_is_refused(size: int) -> None:
    with pytest.raises(InvalidInputError, match=f"file: got {size} bytes, wanted 0 to {MOST_BYTES} in a volume"):
        check_volume(0, size, 1)


def test_more_pages_than_have_numbers_are_refused() -> None:
    with pytest.raises(InvalidInputError, match=f"file: got {MOST_PAGES + 1} pages, wanted at most {MOST_PAGES}"):
        check_volume(0, 0, MOST_PAGES + 1)


def test_all_that_is_allowed_fits() -> None:
    check_volume(0, 0, 1)
    check_volume((1 << 32) - 1, MOST_BYTES, MOST_PAGES)
    for header in EXTREMES:
        assert len(header.to_bytes()) == HEADER_BYTES


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

    def test_it_comes_back(self, levels: int) -> None:
        for header, symbols in zip(EXTREMES, encode_headers(EXTREMES, levels), strict=True):
            phase, kappa = noisy(symbols, levels, np.inf, np.random.default_rng(0))
            assert decode_header(phase, kappa, levels) == header

    def test_it_comes_back_through_noise(self, levels: int) -> None:
        # 3.5 deviations to the middle between its levels, two of them where they are but two
        kappa = max(1.5, (3.5 / (np.pi / header_levels(levels))) ** 2)
        rng = np.random.default_rng(levels)
        symbols = encode_headers([HEADER], levels)[0]
        for _ in range(20):
            assert decode_header(*noisy(symbols, levels, kappa, rng), levels) == HEADER

    @pytest.mark.parametrize("kappa", [0.0, 1.0, 1e6])
    def test_noise_is_no_header(self, levels: int, kappa: float) -> None:
        rng = np.random.default_rng(levels)
        for _ in range(10):
            phase = rng.uniform(-np.pi, np.pi, header_symbols(levels))
            assert decode_header(phase, np.full(phase.shape, kappa), levels) is None
