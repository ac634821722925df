"""Pages to write: what is written comes back, what is damaged is refused by name, nothing is left by half."""

import json
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from lightpage.device.profile import parse_profile
from lightpage.errors import PageError, RecordingError
from lightpage.page.symbols import random_symbols
from lightpage.recording.pages import Pages, PagesWriter
from tests.lightpage.recording.test_recording import array, attribute, small_profile
from tests.lightpage.refused import refused

LEVELS = 16
PROFILE = small_profile()
CODE = {"levels": LEVELS, "coded_bits": 2, "needed_information": 0.75, "volume": 7}
SYMBOLS = random_symbols(PROFILE, LEVELS, 7, np.random.default_rng(1))


def write(path: Path, symbols: np.ndarray = SYMBOLS) -> Path:
    with PagesWriter(path, PROFILE, LEVELS, CODE) as writer:
        for start in range(0, len(symbols), 3):
            writer.append(symbols[start : start + 3])
    return path


class TestWriting:
    def test_what_is_written_comes_back(self, tmp_path: Path) -> None:
        path = write(tmp_path / "p.h5")
        with Pages.open(path) as pages:
            assert (len(pages), pages.levels, pages.page_shape, pages.path) == (7, LEVELS, PROFILE.page_shape, path)
            assert json.loads(pages.code or "") == CODE
            assert np.array_equal(list(pages), SYMBOLS)
            for page in (-7, 5, 6):
                assert np.array_equal(pages[page], SYMBOLS[page])
            for page in (-8, 7):
                with pytest.raises(IndexError):
                    pages[page]
            assert pages[5].dtype == np.uint8

    def test_the_layout_is_the_documented_one(self, tmp_path: Path) -> None:
        with h5py.File(write(tmp_path / "p.h5")) as file:
            assert set(file) == {"symbols"}
            assert set(file.attrs) == {"format", "version", "levels", "profile", "code"}
            assert (file.attrs["format"], file.attrs["version"], file.attrs["levels"]) == ("lightpage-pages", 1, LEVELS)
            assert parse_profile(str(file.attrs["profile"])) == PROFILE
            assert (file["symbols"].dtype, file["symbols"].chunks) == (np.uint8, (1, *PROFILE.page_shape))

    def test_an_interruption_leaves_the_earlier_file(self, tmp_path: Path) -> None:
        path = write(tmp_path / "p.h5")
        before = path.read_bytes()
        with pytest.raises(KeyboardInterrupt), PagesWriter(path, PROFILE, LEVELS, CODE) as writer:  # noqa: PT012
            writer.append(SYMBOLS[0])
            assert path.read_bytes() == before
            raise KeyboardInterrupt
        assert [entry.name for entry in tmp_path.iterdir()] == ["p.h5"]
        assert path.read_bytes() == before

    def test_what_are_no_symbols_is_refused_and_nothing_left(self, tmp_path: Path) -> None:
        with refused("p.h5", 16, PageError):
            write(tmp_path / "p.h5", np.full((2, 6, 9), LEVELS, np.uint8))
        assert list(tmp_path.iterdir()) == []


class TestReading:
    @pytest.mark.parametrize(
        ("change", "subject", "got"),
        [
            (attribute("format", "lightpage-recording"), "'format'", "lightpage-recording"),
            (attribute("version", 2), "'version'", 2),
            (attribute("levels", 1), "'levels'", 1),
            (lambda file: file.__delitem__("symbols"), "'symbols'", "none"),
            (array("symbols", lambda d: d.astype(np.uint16)), "'symbols'", "uint16"),
            (array("symbols", lambda d: d[0]), "'symbols'", (6, 9)),
            (array("symbols", lambda d: d[:0]), "'symbols'", (0, 6, 9)),
        ],
    )
    def test_a_foreign_file_is_refused_by_name(
        self, tmp_path: Path, change: Callable[[h5py.File], None], subject: str, got: object
    ) -> None:
        path = write(tmp_path / "p.h5")
        with h5py.File(path, "r+") as file:
            change(file)
        with refused(subject, got):
            Pages.open(path)

    def test_pages_by_other_software_are_read(self, tmp_path: Path) -> None:
        path = tmp_path / "p.h5"
        with h5py.File(path, "w") as file:
            file.attrs["format"] = np.bytes_(b"lightpage-pages")
            file.attrs["version"] = np.array([1], np.int16)
            file.attrs["levels"] = np.uint8(LEVELS)
            file["symbols"] = SYMBOLS
        with Pages.open(path) as pages:
            assert (pages.levels, pages.code) == (LEVELS, None)
            assert np.array_equal(list(pages), SYMBOLS)

    def test_a_symbol_beyond_the_levels_is_refused_where_it_is(self, tmp_path: Path) -> None:
        path = write(tmp_path / "p.h5")
        with h5py.File(path, "r+") as file:
            file["symbols"][3, 2, 1] = LEVELS
        with Pages.open(path) as pages:
            assert np.array_equal(pages[2], SYMBOLS[2])
            with refused("p.h5: page 3", 16, RecordingError):
                list(pages)
