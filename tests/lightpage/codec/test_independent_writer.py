"""docs/formats.md says all of a page of user bytes: a writer made from it alone makes the project's pages."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from click.testing import CliRunner

from lightpage.codec.code import Code
from lightpage.codec.page_bytes import FileFacts, Header
from lightpage.codec.page_codec import PageCodec
from lightpage.codec.volume import Volume, encode_volume
from lightpage.device.profile import Profile, load_profile
from lightpage.page.symbols import pilot_mask, pilot_symbols
from lightpage.recording.pages import Pages
from runtime.commands.encode import encode
from tests.lightpage.codec import independent_writer as writer

CODES = [
    Code(levels=2, coded_bits=1, rate_per_mille=340),
    Code(levels=4, coded_bits=2, rate_per_mille=667, corrections=1),
    Code(levels=8, coded_bits=1, rate_per_mille=501),
    Code(levels=64, coded_bits=6, rate_per_mille=870),
    Code(levels=128, coded_bits=2, rate_per_mille=800, corrections=3),
    Code(levels=256, coded_bits=2, rate_per_mille=960, corrections=32),
    Code(levels=256, coded_bits=8, rate_per_mille=700),
]
WORKED = json.loads(writer.VECTORS.read_text("utf-8"))


def parameters(code: Code) -> writer.Parameters:
    return writer.Parameters(code.levels, code.coded_bits, code.rate_per_mille, code.corrections)


def some_bytes(count: int, seed: int = 0) -> bytes:
    return np.random.default_rng(seed).bytes(count)


def project_pages(
    code: Code, mask: np.ndarray, pilots: np.ndarray, file: bytes, *, volume: int, k: int, m: int
) -> dict[int, np.ndarray]:
    """All pages of a file by their numbers, as the project makes them; `pilots` is a full page of levels."""
    codec = PageCodec(code, mask)
    whole = Volume.of_file(io.BytesIO(file), volume, codec.user_bytes, k, m)
    pages = np.concatenate(list(encode_volume(codec, whole, io.BytesIO(file), pilots[mask])))
    numbers = [number for group in range(whole.groups) for number in whole.numbers_in(group)]
    return dict(zip(numbers, pages, strict=True))


def assert_same(ours: dict[int, np.ndarray], theirs: dict[int, np.ndarray]) -> None:
    assert list(ours) == list(theirs)
    for page, symbols in ours.items():
        assert symbols.dtype == theirs[page].dtype == np.uint8
        assert np.array_equal(symbols, theirs[page]), page


def masked_layout(mask: np.ndarray, pilots: np.ndarray) -> writer.Layout:
    levels = [int(level) if pilot else None for level, pilot in zip(pilots.ravel(), mask.ravel(), strict=True)]
    return writer.Layout(*mask.shape, tuple(levels))


@pytest.mark.parametrize("code", CODES, ids=Code.describe)
def test_a_volume_of_two_groups_is_the_same(code: Code) -> None:
    """The second group has one data page of three, partly filled; both have two parity pages."""
    bench = load_profile("bench")
    layout = writer.shipped_layout("bench", code.levels)
    size = writer.page_user_bytes(parameters(code), layout)
    file, volume = some_bytes(3 * size + size // 2), 0xFEDC_BA98
    ours = writer.file_pages(parameters(code), layout, file, volume=volume, k=3, m=2)
    assert list(ours) == [0, 1, 2, 3, 4, 5, 8, 9]
    mask, pilots = pilot_mask(bench), pilot_symbols(bench, code.levels)
    assert_same(ours, project_pages(code, mask, pilots, file, volume=volume, k=3, m=2))


@pytest.mark.parametrize("length", ["nothing", "one byte", "a whole page", "a page and a byte"])
def test_a_file_of_any_length_is_the_same(length: str) -> None:
    code, bench = CODES[3], load_profile("bench")
    layout = writer.shipped_layout("bench", code.levels)
    size = writer.page_user_bytes(parameters(code), layout)
    lengths = {"nothing": 0, "one byte": 1, "a whole page": size, "a page and a byte": size + 1}
    file = some_bytes(lengths[length])
    ours = writer.file_pages(parameters(code), layout, file, volume=0, k=2, m=1)
    assert list(ours) == ([0, 1, 2] if length == "a page and a byte" else [0, 2])
    mask, pilots = pilot_mask(bench), pilot_symbols(bench, code.levels)
    assert_same(ours, project_pages(code, mask, pilots, file, volume=0, k=2, m=1))


@pytest.mark.parametrize(
    ("code", "blocks", "words"),
    [
        (Code(levels=128, coded_bits=2, rate_per_mille=800, corrections=3), 11, 8),
        (Code(levels=16, coded_bits=4, rate_per_mille=613, corrections=2), 17, 3),
        (Code(levels=256, coded_bits=1, rate_per_mille=345), 3, 0),
    ],
    ids=lambda value: value.describe() if isinstance(value, Code) else str(value),
)
def test_a_page_of_many_blocks_and_words_is_the_same(code: Code, blocks: int, words: int) -> None:
    """With pilots of its own at random places, and numbers that fill the header's fields."""
    rng = np.random.default_rng(5)
    mask = rng.random((200, 300)) < 0.03
    pilots = rng.integers(code.levels, size=mask.shape, dtype=np.uint8)
    layout = masked_layout(mask, pilots)
    parts = writer.sizes(parameters(code), layout.pilots.count(None))
    assert (parts.blocks, parts.words) == (blocks, words)
    codec, user = PageCodec(code, mask), some_bytes(parts.user_bytes)
    header = Header(code.id, (1 << 32) - 2, (1 << 24) - 3, (1 << 40) - 4)
    user_bytes, facts = np.frombuffer(user, np.uint8)[None], FileFacts(200, 55, 0x89ABCDEF)
    theirs = codec.encode([header], user_bytes, facts, pilots[mask])[0]
    ours = writer.page_symbols(
        parameters(code),
        layout,
        user,
        volume=header.volume,
        checksum=0x89ABCDEF,
        page=header.page,
        file_bytes=header.volume_bytes,
        k=200,
        m=55,
    )
    assert np.array_equal(np.array(ours).reshape(mask.shape), theirs)


def profile_with(**page: object) -> Profile:
    bench = load_profile("bench")
    return bench.model_copy(update={"page": bench.page.model_copy(update=page)})


@pytest.mark.parametrize("levels", [2, 5, 64, 256])
@pytest.mark.parametrize(
    "profile",
    [
        load_profile("bench"),
        load_profile("paper"),
        profile_with(rows=3, columns=1),
        profile_with(rows=40, columns=2, pilot_fraction=0.3, pilot_seed=(1 << 32) + 7),
        profile_with(rows=7, columns=90, pilot_fraction=0.125, pilot_seed=12345),
        profile_with(rows=9, columns=13, pilot_fraction=1.0),
    ],
    ids=lambda profile: f"{profile.page.rows} x {profile.page.columns}",
)
def test_pilots_of_a_profile_are_the_same(profile: Profile, levels: int) -> None:
    page = profile.page
    layout = writer.profile_layout(page.rows, page.columns, page.pilot_fraction, page.pilot_seed, levels)
    mask = pilot_mask(profile)
    assert layout == masked_layout(mask, pilot_symbols(profile, levels))


def test_a_foreign_file_of_pages_is_the_commands_own(tmp_path: Path) -> None:
    """Its symbols and all attributes; the code's JSON text by what it means."""
    code, bench = CODES[4], load_profile("bench")
    layout = writer.shipped_layout("bench", code.levels)
    file = some_bytes(2 * writer.page_user_bytes(parameters(code), layout) + 9)
    (tmp_path / "file").write_bytes(file)
    (tmp_path / "code.toml").write_text(code.to_toml())
    options = f"{tmp_path}/file --profile bench --code {tmp_path}/code.toml --out {tmp_path}/own.h5"
    arguments = [*options.split(), "--volume", "77", "--data-pages", "2", "--parity-pages", "1"]
    CliRunner().invoke(encode, arguments, standalone_mode=False, catch_exceptions=False)
    writer.write_pages(
        tmp_path / "foreign.h5",
        parameters(code),
        layout,
        file,
        volume=77,
        k=2,
        m=1,
        profile=bench.to_toml(),
        needed_information=code.needed_information,
    )
    with Pages.open(tmp_path / "own.h5") as own, Pages.open(tmp_path / "foreign.h5") as foreign:
        assert (own.levels, len(own)) == (foreign.levels, len(foreign)) == (128, 5)
        assert np.array_equal(np.stack(list(own)), np.stack(list(foreign)))
        assert json.loads(str(own.code)) == json.loads(str(foreign.code))
    with h5py.File(tmp_path / "own.h5") as own, h5py.File(tmp_path / "foreign.h5") as foreign:
        assert set(own.attrs) == set(foreign.attrs) == {"format", "version", "levels", "profile", "code"}
        assert [own.attrs[name] == foreign.attrs[name] for name in own.attrs if name != "code"] == [True] * 4
        assert own["symbols"].chunks == foreign["symbols"].chunks


def test_the_writer_makes_the_test_vectors() -> None:
    assert writer.make_vectors() == WORKED


@pytest.mark.parametrize("vector", WORKED, ids=lambda vector: f"{vector['code']['levels']} levels")
def test_the_project_makes_the_test_vectors(vector: dict[str, Any]) -> None:
    code, profile = Code(**vector["code"]), load_profile(vector["profile"])
    mask, pilots = pilot_mask(profile), pilot_symbols(profile, code.levels)
    assert PageCodec(code, mask).user_bytes == vector["page_bytes"]
    file = bytes(i % 256 for i in range(vector["file_bytes"]))
    pages = project_pages(code, mask, pilots, file, volume=vector["volume"], k=vector["k"], m=vector["m"])
    assert list(pages) == [page["number"] for page in vector["pages"]]
    for told in vector["pages"]:
        header = Header(code.id, vector["volume"], told["number"], vector["file_bytes"])
        assert header.to_bytes().hex() == told["header"]
        symbols = pages[told["number"]]
        assert symbols.ravel()[:64].tolist() == told["first_symbols"]
        assert hashlib.sha256(symbols.tobytes()).hexdigest() == told["symbols_sha256"]


def reversed_bits(value: int, width: int) -> list[int]:
    return [value >> shift & 1 for shift in range(width)]


@pytest.mark.parametrize(
    ("name", "other"),
    [
        ("bits_of_number", reversed_bits),
        ("reed_solomon_parity", lambda data, corrections: [0] * 2 * corrections),
        ("crc_32c", lambda data: 0),
        ("random_order", lambda seed, count: list(range(count))),
        ("parity_page", lambda group, index: bytes(len(group[0]))),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_writer_with_one_fault_is_told_apart(
    name: str, other: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer, name, other)
    assert writer.make_vectors() != WORKED
