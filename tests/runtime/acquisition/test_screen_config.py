"""A monitor that a TOML file names shows pages of whatever levels they have, and each mistake has a line of its own."""

from __future__ import annotations

from collections.abc import Iterator
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
from tests.runtime.modulator.xvfb import XServer, x_server

pytest.importorskip("xcffib")

ROWS, COLUMNS = 800, 1280
WAIT_S = 30.0


@pytest.fixture
def server(tmp_path: Path) -> Iterator[XServer]:
    with x_server(tmp_path / "screen", "-screen", "0", f"{COLUMNS}x{ROWS}x24") as running:
        yield running


def opened(tmp_path: Path, display: str, *lines: str, rows_px: int = ROWS) -> CameraSource:
    (tmp_path / "profile.toml").write_text(small_profile().to_toml())
    text = f"""
profile = "profile.toml"
[in_phase]
serial = "1"
[quadrature]
serial = "2"
[trigger]
kind = "software"
[modulator]
kind = "screen"
x_display = "{display}"
rows_px = {rows_px}
columns_px = {COLUMNS}
settle_s = 0.0
"""
    (tmp_path / "device.toml").write_text("\n".join([text, *lines]))
    return open_camera(str(tmp_path / "device.toml"))


def shown(source: CameraSource, server: XServer, levels: int) -> set[int]:
    """Grey values on the screen once a page of so many levels is."""
    assert source.modulator is not None
    symbols = random_symbols(small_profile(), levels, 1, np.random.default_rng(levels))[0]
    source.modulator.show(symbols, levels, 0, WAIT_S)
    return set(np.unique(server.greys()).tolist())


def test_a_page_is_on_the_screen_that_the_file_names(tmp_path: Path, server: XServer) -> None:
    source = opened(tmp_path, server.display)
    assert shown(source, server, 4) == {0, 64, 128, 192}
    source.close()


def test_a_lookup_table_may_be_named(tmp_path: Path, server: XServer) -> None:
    (tmp_path / "table.csv").write_text("10 20 30 40")
    source = opened(tmp_path, server.display, 'lookup_table = "table.csv"')
    assert shown(source, server, 4) == {0, 10, 20, 30, 40}
    assert source.modulator is not None
    with pytest.raises(InvalidInputError, match="4 grey values, wanted 8"):
        source.modulator.open(WAIT_S, 8)
    source.close()
    with pytest.raises(InvalidInputError, match=r"absent\.csv: got no such file"):
        opened(tmp_path, server.display, 'lookup_table = "absent.csv"')


def test_the_greys_follow_the_levels_of_the_pages_that_are_shown(tmp_path: Path, server: XServer) -> None:
    source = opened(tmp_path, server.display)
    with PagesWriter(tmp_path / "pages.h5", small_profile(), 128, {}) as writer:
        writer.append(random_symbols(small_profile(), 128, 1, np.random.default_rng(1)))
    source.show_pages(PageStore(small_profile(), Pages.open(tmp_path / "pages.h5")))
    assert source.modulator is not None
    source.modulator.show(source.pages[0], source.levels, 0, WAIT_S)
    assert set(np.unique(server.greys())) <= set(range(0, 256, 2))
    source.show_pages(PageStore(small_profile()))
    source.pages.append(random_symbols(small_profile(), 4, 1, np.random.default_rng(1)), 4)  # as by an upload
    source.modulator.show(source.pages[0], source.levels, 0, WAIT_S)
    assert set(np.unique(server.greys())) == {0, 64, 128, 192}
    with pytest.raises(PageError):
        source.modulator.show(source.pages[0], 2, 0, WAIT_S)
    source.close()


def test_monitor_resolution_and_display_are_told_before_a_camera_is_looked_for(tmp_path: Path, server: XServer) -> None:
    for display, rows_px, more, told in (
        (server.display, ROWS, "monitor = 3", r"monitor 3: got monitors 0 of 1280x800 pixels, wanted monitor 3$"),
        (server.display, 900, "", r"got 1280x800 pixels, wanted 1280x900 pixels.* rows_px"),
        (":4077", ROWS, "", r"got no connection to X display :4077 .*wanted an X server that runs"),
    ):
        source = opened(tmp_path, display, more, rows_px=rows_px)
        with pytest.raises(SourceError, match=told):
            source.arm()
        source.close()
