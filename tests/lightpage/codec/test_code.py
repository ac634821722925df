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


@pytest.mark.parametrize(
    "code",
    [
        CODE,
        Code(levels=2, coded_bits=1, rate_per_mille=340),
        Code(levels=256, coded_bits=8, rate_per_mille=960, corrections=32, needed_information=1 / 3),
    ],
)
def test_it_comes_back_from_toml(code: Code, tmp_path: Path) -> None:
    assert parse_code(code.to_toml(), "code") == code
    code.save(tmp_path / "code.toml")
    assert load_code(tmp_path / "code.toml") == code
    assert [path.name for path in tmp_path.iterdir()] == ["code.toml"]


def test_what_may_be_left_out_has_a_default() -> None:
    code = parse_code("levels = 16\ncoded_bits = 2\nrate_per_mille = 700", "code")
    assert (code.corrections, code.needed_information) == (0, 1.0)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("levels", "1"),
        ("levels", "512"),
        ("levels", "48"),
        ("levels", "64.5"),
        ("levels", '"many"'),
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
        ("needed_information", "inf"),
    ],
)
def test_each_bad_value_is_refused_by_name(key: str, value: str) -> None:
    with refused("my code", value.strip('"') if value in ("48", "7") else key):
        parse_code(changed(key, value), "my code")


def test_missing_and_unknown_keys_are_refused_by_name() -> None:
    with refused("my code", "rate: "):
        parse_code(TEXT + "rate = 1\n", "my code")
    with refused("my code", "rate_per_mille: "):
        parse_code("levels = 16\ncoded_bits = 2", "my code")


def test_what_is_no_toml_is_refused(tmp_path: Path) -> None:
    with refused("my code", "TOML"):
        parse_code("levels: 16", "my code")
    path = tmp_path / "code.toml"
    with refused("code.toml"):
        load_code(path)
    path.write_bytes(b"levels = \xff")
    with refused("code.toml", "line 1, column 10"):
        load_code(path)
    path.write_text("levels = 5")
    with refused("code.toml", "coded_bits: "):
        load_code(path)
    with refused("code"):
        CODE.save(tmp_path / "no" / "code.toml")


def test_the_id_is_the_documented_one() -> None:
    assert CODE.id == crc16(b"64 2 755 3")


def test_the_id_changes_with_every_parameter_that_the_page_depends_on() -> None:
    changes = [{"levels": 128}, {"coded_bits": 3}, {"rate_per_mille": 760}, {"corrections": 4}]
    ids = [CODE.id, *(CODE.model_copy(update=change).id for change in changes)]
    assert len(set(ids)) == 5
    assert CODE.model_copy(update={"needed_information": 0.5}).id == CODE.id


def test_it_describes_itself() -> None:
    assert CODE.describe() == "64 levels, 2 of 6 bits coded at rate 0.755, 3 corrections a word"
