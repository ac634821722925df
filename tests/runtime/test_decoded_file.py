"""Decoded pages are a whole file or none, whatever the disk does."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from lightpage.errors import SurroundingsError
from runtime.client.decoded_file import DecodedWriter
from tests.lightpage.full_disk import full_disk


@dataclass(frozen=True)
class Page:
    symbols: np.ndarray
    confidence: np.ndarray
    model_version: str = "1"
    page: int | None = None


@pytest.mark.parametrize("room", [0, 3_000, 20_000])
def test_a_full_disk_leaves_the_earlier_file_and_no_other(tmp_path: Path, room: int) -> None:
    path = tmp_path / "d.h5"
    path.write_text("earlier")
    writing = pytest.raises(SurroundingsError, match=r"d\.h5")
    with full_disk(room), writing, DecodedWriter(path, 16) as writer:
        for seed in range(3):
            rng = np.random.default_rng(seed)
            writer.append(Page(rng.integers(0, 16, (40, 50), dtype=np.uint8), rng.random((40, 50), np.float32)))
    assert path.read_text() == "earlier"
    assert list(tmp_path.iterdir()) == [path]
