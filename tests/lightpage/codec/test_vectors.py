"""Pages and pilots are those of docs/reference/formats.md, as an independent writer made them (vectors.json)."""

import hashlib
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lightpage.codec.code import Code
from lightpage.codec.page_bytes import FileFacts, Header
from lightpage.codec.page_codec import PageCodec
from lightpage.codec.volume import Volume, encode_volume
from lightpage.device.profile import Profile, load_profile
from lightpage.page.symbols import pilot_mask, pilot_symbols

VECTORS = json.loads(Path(__file__).with_name("vectors.json").read_text("utf-8"))


def profile_of(vector: dict[str, Any]) -> Profile:
    bench = load_profile("bench")
    return bench.model_copy(update={"page": bench.page.model_copy(update=vector["page"])})


def codec_of(vector: dict[str, Any]) -> tuple[PageCodec, np.ndarray]:
    """The codec, and the levels of the pilots."""
    code, profile = Code(**vector["code"]), profile_of(vector)
    mask = pilot_mask(profile)
    return PageCodec(code, mask), pilot_symbols(profile, code.levels)[mask]


def file_of(count: int) -> bytes:
    return bytes(i % 256 for i in range(count))


def sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


@pytest.mark.parametrize("vector", VECTORS["volumes"], ids=lambda v: f"{v['code']} {v['file_bytes']} bytes")
def test_files_are_written_on_the_pages_of_the_vectors(vector: dict[str, Any]) -> None:
    codec, pilots = codec_of(vector)
    assert codec.user_bytes == vector["page_bytes"]
    file = io.BytesIO(file_of(vector["file_bytes"]))
    volume = Volume.of_file(file, vector["volume"], codec.user_bytes, vector["k"], vector["m"])
    pages = np.concatenate(list(encode_volume(codec, volume, file, pilots)))
    numbers = [number for group in range(volume.groups) for number in volume.numbers_in(group)]
    assert numbers == [page["number"] for page in vector["pages"]]
    assert pages.dtype == np.uint8
    for symbols, told in zip(pages, vector["pages"], strict=True):
        header = Header(codec.code.id, volume.id, told["number"], volume.file_bytes)
        assert header.to_bytes().hex() == told["header"]
        first = told.get("first_symbols", [])
        assert symbols.ravel()[: len(first)].tolist() == first
        assert sha256(symbols.tobytes()) == told["symbols_sha256"]


@pytest.mark.parametrize("vector", VECTORS["single_pages"], ids=lambda v: str(v["code"]))
def test_pages_of_many_blocks_and_with_full_headers_are_those_of_the_vectors(vector: dict[str, Any]) -> None:
    codec, pilots = codec_of(vector)
    facts, user = vector["facts"], file_of(vector["user_bytes"])
    assert (codec.blocks, codec.user_bytes) == (vector["blocks"], vector["user_bytes"])
    header = Header(codec.code.id, facts["volume"], facts["page"], facts["file_bytes"])
    data, file = np.frombuffer(user, np.uint8)[None], FileFacts(facts["k"], facts["m"], facts["checksum"])
    assert sha256(codec.encode([header], data, file, pilots).tobytes()) == vector["symbols_sha256"]


@pytest.mark.parametrize("vector", VECTORS["pilots"], ids=lambda v: f"{v['page']} {v['levels']}")
def test_pilots_are_those_of_the_vectors(vector: dict[str, Any]) -> None:
    profile = profile_of(vector)
    mask = pilot_mask(profile)
    assert np.count_nonzero(mask) == vector["count"]
    pilots = np.where(mask, pilot_symbols(profile, vector["levels"]).astype("<i2"), np.int16(-1)).astype("<i2")
    assert sha256(pilots.tobytes()) == vector["pilots_sha256"]
