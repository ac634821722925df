"""The parameters of a code: kept as TOML, refused by name, told apart by their id."""

from __future__ import annotations

from pathlib import Path

import pytest

from lightpage.codec.checksum import crc16
from lightpage.codec.code import Code, load_code, parse_code
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
    with refused("my code", "TOML"):
        parse_code("levels: 16", "my code")
    with refused("my code", "rate: "):
        parse_code(TEXT + "rate = 1\n", "my code")
    with refused("code.toml"):
        load_code(tmp_path / "code.toml")
    (tmp_path / "code.toml").write_text("levels = 5")
    with refused("code.toml", "coded_bits: "):
        load_code(tmp_path / "code.toml")


def test_the_id_is_the_documented_one() -> None:
    assert CODE.id == crc16(b"64 2 755 3")
