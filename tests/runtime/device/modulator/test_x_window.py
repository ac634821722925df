"""The window of a modulator, on X servers without a monitor: which pixels it has, and when it goes."""

from __future__ import annotations

import os
import shutil
import struct
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from lightpage.errors import InvalidInputError, SourceError
from lightpage.page.symbols import random_symbols
from lightpage.runtime.device.acquisition.camera_devices import open_camera
from lightpage.runtime.device.modulator.lookup_table import linear_table
from lightpage.runtime.device.modulator.screen.raster import ScreenSettings
from lightpage.runtime.device.modulator.screen.screen import ScreenModulator
from tests.lightpage.small import small_profile
from tests.processes import children
from tests.waiting import eventually

xcffib = pytest.importorskip("xcffib")
from xcffib import randr, xproto  # noqa: E402

ROOT = Path(__file__).resolve().parents[4]
SCREEN = "lightpage.runtime.device.modulator.screen"
PROFILE = small_profile()
LEVELS = 16
WAIT_S = 60.0
OFFSET_PX = 31
ROWS, COLUMNS = 800, 1280


class XServer:
    """An Xvfb that runs: `display` is its name, e.g. ``:3``."""

    def __init__(self, folder: Path, *options: str) -> None:
        if shutil.which("Xvfb") is None:
            pytest.skip("no Xvfb (apt-get install xvfb)")
        folder.mkdir(exist_ok=True)
        self._folder = folder
        ours, its = os.pipe()
        with os.fdopen(ours) as reader:
            command = ["Xvfb", "-displayfd", str(its), "-nolisten", "tcp", "-fbdir", str(folder), *options]
            self._process = subprocess.Popen(command, pass_fds=[its], stderr=subprocess.DEVNULL)
            os.close(its)
            self.display = ":" + reader.readline().strip()  # an Xvfb that ends closes its end
        assert self.display != ":"

    def picture(self, screen: int = 0) -> NDArray[np.uint8]:
        """What is on its screen, by the server itself: red, green and blue [row, column, 3]."""
        content = (self._folder / f"Xvfb_screen{screen}").read_bytes()
        head = struct.unpack(">25I", content[:100])
        columns, rows, row_bytes, colours = head[4], head[5], head[12], head[19]
        start = head[0] + colours * 12
        pixels = np.frombuffer(content, np.uint8, rows * row_bytes, start).reshape(rows, row_bytes // 4, 4)
        return pixels[:, :columns, 2::-1]

    def greys(self, screen: int = 0) -> NDArray[np.uint8]:
        """The same of a screen that is grey all over: [row, column]."""
        picture = self.picture(screen)
        assert (picture == picture[..., :1]).all()
        return picture[..., 0]

    def __enter__(self) -> XServer:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait(WAIT_S)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[XServer]:
    with XServer(tmp_path_factory.mktemp("screen"), "-screen", "0", f"{COLUMNS}x{ROWS}x24") as running:
        yield running


def screen_of(display: str | None, **more: object) -> ScreenModulator:
    given = {"rows_px": ROWS, "columns_px": COLUMNS, "settle_s": 0.0, "background_grey": 7, "x_display": display}
    settings = ScreenSettings.model_validate({**given, **more})
    return ScreenModulator(settings, PROFILE, linear_table)


@pytest.fixture
def screen(server: XServer) -> Iterator[ScreenModulator]:
    made = screen_of(server.display, offset_x_px=OFFSET_PX)
    yield made
    made.close()
    eventually(lambda: not server.picture().any())


def shown(screen: ScreenModulator, seed: int = 1, offset_x_px: int = OFFSET_PX) -> NDArray[np.uint8]:
    """Show a page, and return what is to be seen then, every pixel of the modulator by itself.

    16 grey values from one level to the next, 7 beside the page.
    """
    symbols = np.random.default_rng(seed).integers(0, LEVELS, PROFILE.page_shape, dtype=np.uint8)
    screen.show(symbols, LEVELS, seed, WAIT_S)
    size = PROFILE.page.symbol_size_px
    rows, columns = PROFILE.page_shape
    top, left = (ROWS - rows * size) // 2, (COLUMNS - columns * size) // 2 + offset_x_px
    expected = np.full((ROWS, COLUMNS), 7, np.uint8)
    squares = np.kron(16 * symbols, np.ones((size, size), np.uint8))
    expected[top : top + rows * size, left : left + columns * size] = squares
    return expected


def windows_of(parent: int) -> list[int]:
    return children(parent, f"{SCREEN}.screen_window")


def test_each_pixel_shows_the_grey_of_its_symbol_and_no_mouse_pointer(server: XServer, screen: ScreenModulator) -> None:
    connection = xcffib.connect(server.display)
    root = connection.setup.roots[0].root
    font, cursor = connection.generate_id(), connection.generate_id()
    connection.core.OpenFontChecked(font, len("cursor"), "cursor").check()
    connection.core.CreateGlyphCursorChecked(cursor, font, font, 0, 1, *[0xFFFF] * 3, 0, 0, 0).check()
    connection.core.ChangeWindowAttributesChecked(root, xproto.CW.Cursor, [cursor]).check()
    connection.core.WarpPointerChecked(0, root, 0, 0, 0, 0, COLUMNS // 2, ROWS // 2).check()
    eventually(lambda: server.picture().any())  # it is there
    for page in (1, 2):
        np.testing.assert_array_equal(shown(screen, page), server.greys())
        assert screen.shows()
    assert len(windows_of(os.getpid())) == 1
    assert f"{SCREEN}.x_window" not in sys.modules  # its process alone talks to the server
    connection.core.ChangeWindowAttributesChecked(root, xproto.CW.Cursor, [0]).check()
    connection.disconnect()


def test_what_covers_the_window_is_noticed_and_put_below_by_the_next_page(
    server: XServer, screen: ScreenModulator
) -> None:
    shown(screen)
    connection = xcffib.connect(server.display)
    root, window = connection.setup.roots[0], connection.generate_id()
    mask, kind = xproto.CW.BackPixel | xproto.CW.OverrideRedirect, xproto.WindowClass.InputOutput
    place = (24, window, root.root, 600, 400, 50, 50, 0, kind, root.root_visual, mask, [0xFFFFFF, 1])
    connection.core.CreateWindowChecked(*place).check()
    connection.core.MapWindowChecked(window).check()
    assert not screen.shows()
    expected = shown(screen)
    np.testing.assert_array_equal(server.greys(), expected)
    assert screen.shows()
    top = xproto.StackMode.Above
    connection.core.ConfigureWindowChecked(window, xproto.ConfigWindow.StackMode, [top]).check()
    assert not screen.shows()
    connection.core.DestroyWindowChecked(window).check()
    eventually(lambda: (server.greys() == expected).all())  # the server repairs it
    connection.disconnect()


def test_the_chosen_screen_and_monitor_alone_are_covered(tmp_path: Path) -> None:
    """The second screen has two monitors side by side, as the server's list of monitors has them."""
    options = ("-screen", "0", "640x480x24", "-screen", "1", f"{640 + COLUMNS}x{ROWS}x24")
    with XServer(tmp_path / "screens", *options) as server:
        display = server.display + ".1"
        connection = xcffib.connect(display)
        root, monitors = connection.setup.roots[1].root, connection(randr.key)
        outputs = monitors.GetScreenResources(root).reply().outputs
        for name, x, columns, its in (("left", 0, 640, list(outputs)), ("right", 640, COLUMNS, [])):
            atom = connection.core.InternAtom(False, len(name), name).reply().atom
            info = randr.MonitorInfo.synthetic(atom, 0, 0, len(its), x, 0, columns, ROWS, 300, 200, its)
            monitors.SetMonitorChecked(root, info).check()
        found = [(m.x, m.width) for m in monitors.GetMonitors(root, True).reply().monitors]
        screen = screen_of(display, monitor=found.index((640, COLUMNS)))
        expected = shown(screen, offset_x_px=0)
        np.testing.assert_array_equal(server.greys(1)[:, 640:], expected)
        assert not server.picture(1)[:, :640].any()
        assert not server.picture(0).any()
        screen.close()
        with pytest.raises(SourceError, match="monitor 2"):
            screen_of(display, monitor=2).open(WAIT_S)
        connection.disconnect()


def test_a_server_that_is_not_as_it_must_be_is_refused(
    server: XServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(display: str | None, named: str, **more: object) -> None:
        with pytest.raises(SourceError, match=named):
            screen_of(display, **more).open(WAIT_S)

    refused(server.display, "1920x1080", rows_px=1080, columns_px=1920)
    refused(":4077.1", r":4077\.1")
    for named, depth, *options in (("RANDR", 24, "-extension", "RANDR"), ("16 bits", 16)):
        with XServer(tmp_path / named, "-screen", "0", f"{COLUMNS}x{ROWS}x{depth}", *options) as other:
            refused(other.display, named)
    monkeypatch.delenv("DISPLAY", raising=False)
    refused(None, "DISPLAY")
    (tmp_path / "xcffib.py").write_text("raise ModuleNotFoundError('none here')")
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{ROOT}")
    refused(server.display, "screen extra")
    assert windows_of(os.getpid()) == []


def test_a_configured_screen_shows_the_greys_of_its_table_or_of_the_levels_that_are_shown(
    tmp_path: Path, server: XServer
) -> None:
    (tmp_path / "profile.toml").write_text(PROFILE.to_toml())
    (tmp_path / "table.csv").write_text("10 20 30 40")
    symbols = random_symbols(PROFILE, 4, 1, np.random.default_rng(1))
    for more, greys in (('lookup_table = "table.csv"', {0, 10, 20, 30, 40}), ("", {0, 64, 128, 192})):
        (tmp_path / "device.toml").write_text(f"""
            profile = "profile.toml"
            in_phase = {{serial = "1"}}
            quadrature = {{serial = "2"}}
            trigger = {{kind = "software"}}
            [modulator]
            kind = "screen"
            rows_px = {ROWS}
            columns_px = {COLUMNS}
            x_display = "{server.display}"
            {more}""")
        with closing(open_camera(str(tmp_path / "device.toml"))) as source:
            source.pages.append(symbols, 4)  # as by an upload
            assert source.modulator is not None
            source.modulator.show(source.pages[0], source.levels, 0, WAIT_S)
            assert set(np.unique(server.greys()).tolist()) == greys
            if more:
                with pytest.raises(InvalidInputError):
                    source.modulator.show(source.pages[0], 8, 0, WAIT_S)
