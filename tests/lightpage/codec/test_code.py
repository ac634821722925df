"""The parameters of a code, and the random bits and checksums of its pages."""

from pathlib import Path

import pytest

from lightpage.codec.checksum import Checksum, crc16, crc32c
from lightpage.codec.code import Code, load_code, parse_code
from lightpage.codec.random_bits import random_bytes, random_order, random_words
from tests.lightpage.refused import refused

CODE = Code(levels=64, coded_bits=2, rate_per_mille=755, corrections=3, needed_information=0.8125)
TEXT = CODE.to_toml()


def changed(key: str, value: str) -> str:
    """TOML of the code with another value of one key."""
    lines = [f"{key} = {value}" if line.startswith(f"{key} ") else line for line in TEXT.splitlines()]
    assert lines != TEXT.splitlines()
    return "\n".join(lines)


def test_it_comes_back_from_toml(tmp_path: Path) -> None:
    code = Code(levels=256, coded_bits=8, rate_per_mille=960, corrections=32, needed_information=1 / 3)
    assert parse_code("levels = 2\ncoded_bits = 1\nrate_per_mille = 340", "code").corrections == 0
    code.save(tmp_path / "code.toml")
    assert load_code(tmp_path / "code.toml") == code


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("levels", "1"),
        ("levels", "512"),
        ("levels", "48"),
        ("coded_bits", "0"),
        ("coded_bits", "9"),
        ("coded_bits", "7"),  # of 6
        ("rate_per_mille", "339"),
        ("rate_per_mille", "961"),
        ("corrections", "-1"),
        ("corrections", "33"),
        ("needed_information", "0.0"),
        ("needed_information", "1.01"),
        ("needed_information", "nan"),
    ],
)
def test_each_bad_value_is_refused_by_name(key: str, value: str) -> None:
    with refused("my code", value.strip('"') if value in ("48", "7") else key):
        parse_code(changed(key, value), "my code")


def test_what_is_no_code_is_refused(tmp_path: Path) -> None:
    for got, text in {"TOML": "levels: 16", "unknown": TEXT + "x = 1\n", "a profile": "[lens]\n[pipe]\n"}.items():
        with refused("my code", got):
            parse_code(text, "my code")
    with refused("code.toml"):
        load_code(tmp_path / "code.toml")
    (tmp_path / "code.toml").write_text("levels = 5")
    with refused("code.toml", "coded_bits"):
        load_code(tmp_path / "code.toml")


def test_the_id_is_the_documented_one() -> None:
    assert CODE.id == crc16(b"64 2 755 3")


PUBLISHED = [6457827717110365317, 3203168211198807973, 9817491932198370423, 4593380528125082431, 16408922859458223821]
"""Outputs of seed 1234567, as Rosetta Code and others list them."""


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
