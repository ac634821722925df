"""A monitor that a TOML file names shows pages of whatever levels they have."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lightpage.errors import InvalidInputError, PageError
from lightpage.page.symbols import random_symbols
from lightpage.recording.pages import Pages, PagesWriter
from runtime.acquisition.camera_config import open_camera
from runtime.acquisition.camera_source import CameraSource
from runtime.acquisition.page_store import PageStore
from runtime.errors import SourceError
from tests.lightpage.small import small_profile
from tests.runtime.modulator.xvfb import COLUMNS, ROWS, XServer, x_server

pytest.importorskip("xcffib")

PROFILE = small_profile()
DEVICE = f"""
profile = "profile.toml"
in_phase = {{serial = "1"}}
quadrature = {{serial = "2"}}
trigger = {{kind = "software"}}
[modulator]
kind = "screen"
rows_px = {ROWS}
columns_px = {COLUMNS}
settle_s = 0.0
x_display = """


def opened(folder: Path, display: str, more: str = "", first: str = "") -> CameraSource:
    (folder / "profile.toml").write_text(PROFILE.to_toml())
    (folder / "device.toml").write_text(f'{first}{DEVICE}"{display}"\n{more}\n')
    return open_camera(str(folder / "device.toml"))


def pages(levels: int) -> np.ndarray:
    return random_symbols(PROFILE, levels, 1, np.random.default_rng(levels))


def greys(source: CameraSource, server: XServer, symbols: np.ndarray, levels: int) -> set[int]:
    """Grey values on the screen once a page is."""
    assert source.modulator is not None
    source.modulator.show(symbols, levels, 0, 60.0)
    return set(np.unique(server.greys()).tolist())


def test_the_greys_are_those_of_the_table_or_of_the_levels_that_are_shown(tmp_path: Path) -> None:
    (tmp_path / "table.csv").write_text("10 20 30 40")
    with PagesWriter(tmp_path / "pages.h5", PROFILE, 128, {}) as writer:
        writer.append(pages(128))
    with x_server(tmp_path / "screen") as server:
        source = opened(tmp_path, server.display, 'lookup_table = "table.csv"')
        assert greys(source, server, pages(4)[0], 4) == {0, 10, 20, 30, 40}
        with pytest.raises(InvalidInputError, match="4 grey values"):
            greys(source, server, pages(8)[0], 8)
        source.close()
        source = opened(tmp_path, server.display)
        source.show_pages(PageStore(PROFILE, Pages.open(tmp_path / "pages.h5")))
        assert greys(source, server, source.pages[0], source.levels) <= set(range(0, 256, 2))
        source.show_pages(PageStore(PROFILE))
        source.pages.append(pages(4), 4)  # as by an upload
        assert greys(source, server, source.pages[0], source.levels) == {0, 64, 128, 192}
        with pytest.raises(PageError):
            greys(source, server, source.pages[0], 2)
        source.close()
        source = opened(tmp_path, server.display, "monitor = 3")
        with pytest.raises(SourceError, match=r"^screen.*monitor 3"):  # before a camera is looked for
            source.arm()


def test_a_lookup_table_is_tried_where_that_can_be_done(tmp_path: Path) -> None:
    (tmp_path / "table.csv").write_text("10 20 30 40")
    for name, first in (("absent.csv", ""), ("absent.csv", "levels = 4"), ("table.csv", "levels = 8")):
        with pytest.raises(InvalidInputError, match=name):
            opened(tmp_path, ":5", f'lookup_table = "{name}"', first)
    opened(tmp_path, ":5", 'lookup_table = "table.csv"', "levels = 4").close()
