from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from lightpage.device.profile import Profile
from lightpage.errors import PageError
from runtime.errors import LostShotError, Reason, SourceError
from runtime.modulator.lookup_table import LookupTable
from runtime.modulator.screen import ScreenModulator
from runtime.modulator.settings import ScreenSettings
from tests.lightpage.small import small_profile
from tests.runtime.modulator.xvfb import XServer, x_server

xcffib = pytest.importorskip("xcffib")
from xcffib import randr, xproto  # noqa: E402

ROOT = Path(__file__).resolve().parents[3]
ROWS, COLUMNS = 800, 1280
LEVELS = 16
WAIT_S = 30.0


@pytest.fixture
def profile() -> Profile:
    return small_profile()


@pytest.fixture
def server(tmp_path: Path) -> Iterator[XServer]:
    with x_server(tmp_path / "screen", "-screen", "0", f"{COLUMNS}x{ROWS}x24") as running:
        yield running


def settings_of(display: str, **more: object) -> ScreenSettings:
    values = {"rows_px": ROWS, "columns_px": COLUMNS, "settle_s": 0.0, "background_grey": 7, "x_display": display}
    return ScreenSettings.model_validate({**values, **more})


@pytest.fixture
def modulator(server: XServer, profile: Profile) -> Iterator[ScreenModulator]:
    made = ScreenModulator(settings_of(server.display, offset_x_px=31), profile, LookupTable.linear(LEVELS))
    yield made
    made.close()


def symbols_of(profile: Profile, seed: int) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, LEVELS, profile.page_shape, dtype=np.uint8)


def expected(symbols: NDArray[np.uint8], profile: Profile, offset_x_px: int) -> NDArray[np.uint8]:
    """Every pixel of the modulator by itself: 16 grey values from one level to the next, 7 beside the page."""
    size = profile.page.symbol_size_px
    rows, columns = profile.page_shape
    top, left = (ROWS - rows * size) // 2, (COLUMNS - columns * size) // 2 + offset_x_px
    y, x = np.mgrid[:ROWS, :COLUMNS]
    row, column = (y - top) // size, (x - left) // size
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    levels = symbols[row.clip(0, rows - 1), column.clip(0, columns - 1)]
    return np.where(inside, 16 * levels, 7).astype(np.uint8)


def until(holds: Callable[[], bool]) -> None:
    end = time.monotonic() + WAIT_S
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.02)


def windows_of(parent: int) -> list[int]:
    """Processes of windows that a process has started and that run."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            state, above = (folder / "stat").read_text().rpartition(")")[2].split()[:2]
            command = (folder / "cmdline").read_bytes()
        except OSError:
            continue
        if int(above) == parent and state != "Z" and b"runtime.modulator.screen_window" in command:
            found.append(int(folder.name))
    return found


def runs(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def own_window() -> int:
    until(lambda: bool(windows_of(os.getpid())))  # its process goes by its own name once it has begun
    (found,) = windows_of(os.getpid())
    return found


def lost(modulator: ScreenModulator, profile: Profile, timeout_s: float = WAIT_S) -> str:
    with pytest.raises(LostShotError) as lost:
        modulator.show(symbols_of(profile, 1), LEVELS, 1, timeout_s)
    assert lost.value.reason is Reason.NOT_ON_DISPLAY
    assert not modulator.shows()
    return str(lost.value)


def test_each_pixel_of_the_screen_shows_the_grey_value_of_its_symbol(
    server: XServer, modulator: ScreenModulator, profile: Profile
) -> None:
    for page in (1, 2, 1):
        symbols = symbols_of(profile, page)
        modulator.show(symbols, LEVELS, page, WAIT_S)
        np.testing.assert_array_equal(server.greys(), expected(symbols, profile, 31))
        assert modulator.shows()


def test_the_mouse_pointer_is_not_in_the_picture(server: XServer, modulator: ScreenModulator, profile: Profile) -> None:
    connection = xcffib.connect(server.display)
    root = connection.setup.roots[0].root
    font, cursor = connection.generate_id(), connection.generate_id()
    connection.core.OpenFontChecked(font, len("cursor"), "cursor").check()
    connection.core.CreateGlyphCursorChecked(cursor, font, font, 0, 1, *[0xFFFF] * 3, 0, 0, 0).check()
    connection.core.ChangeWindowAttributesChecked(root, xproto.CW.Cursor, [cursor]).check()
    connection.core.WarpPointerChecked(0, root, 0, 0, 0, 0, COLUMNS // 2, ROWS // 2).check()
    until(lambda: bool(server.picture().any()))  # it is there
    symbols = symbols_of(profile, 1)
    modulator.show(symbols, LEVELS, 1, WAIT_S)
    np.testing.assert_array_equal(server.greys(), expected(symbols, profile, 31))
    connection.disconnect()


def test_the_second_screen_of_a_server_is_found_by_its_name(tmp_path: Path, profile: Profile) -> None:
    options = ("-screen", "0", "640x480x24", "-screen", "1", f"{COLUMNS}x{ROWS}x24")
    with x_server(tmp_path / "screens", *options) as server:
        modulator = ScreenModulator(settings_of(server.display + ".1"), profile, LookupTable.linear(LEVELS))
        symbols = symbols_of(profile, 1)
        modulator.show(symbols, LEVELS, 1, WAIT_S)
        np.testing.assert_array_equal(server.greys(1), expected(symbols, profile, 0))
        assert not server.picture(0).any()
        modulator.close()


def test_the_window_covers_the_chosen_monitor_alone(tmp_path: Path, profile: Profile) -> None:
    """Two monitors side by side on one screen, as the server's list of monitors has them."""
    with x_server(tmp_path / "monitors", "-screen", "0", f"{640 + COLUMNS}x{ROWS}x24") as server:
        connection = xcffib.connect(server.display)
        root, monitors = connection.setup.roots[0].root, connection(randr.key)
        outputs = monitors.GetScreenResources(root).reply().outputs
        for name, x, columns, its in (("left", 0, 640, list(outputs)), ("right", 640, COLUMNS, [])):
            atom = connection.core.InternAtom(False, len(name), name).reply().atom
            info = randr.MonitorInfo.synthetic(atom, 0, 0, len(its), x, 0, columns, ROWS, 300, 200, its)
            monitors.SetMonitorChecked(root, info).check()
        found = [(m.x, m.width) for m in monitors.GetMonitors(root, True).reply().monitors]
        number = found.index((640, COLUMNS))
        settings = settings_of(server.display, monitor=number)
        modulator = ScreenModulator(settings, profile, LookupTable.linear(LEVELS))
        symbols = symbols_of(profile, 1)
        modulator.show(symbols, LEVELS, 1, WAIT_S)
        np.testing.assert_array_equal(server.greys()[:, 640:], expected(symbols, profile, 0))
        assert not server.picture()[:, :640].any()
        modulator.close()
        other = ScreenModulator(settings_of(server.display, monitor=2), profile, LookupTable.linear(LEVELS))
        with pytest.raises(SourceError, match=r"monitors 0 of .*640x800.* wanted monitor 2"):
            other.open(WAIT_S)
        connection.disconnect()


def test_a_page_counts_as_shown_when_the_liquid_crystal_has_settled(server: XServer, profile: Profile) -> None:
    modulator = ScreenModulator(settings_of(server.display, settle_s=0.5), profile, LookupTable.linear(LEVELS))
    modulator.open(WAIT_S)
    begin = time.monotonic()
    modulator.show(symbols_of(profile, 1), LEVELS, 1, WAIT_S)
    assert time.monotonic() - begin > 0.5
    assert "has not settled for 0.5 s" in lost(modulator, profile, 0.45)
    modulator.close()


def test_what_covers_the_window_is_noticed_and_put_below_by_the_next_page(
    server: XServer, modulator: ScreenModulator, profile: Profile
) -> None:
    symbols = symbols_of(profile, 1)
    modulator.show(symbols, LEVELS, 1, WAIT_S)
    connection = xcffib.connect(server.display)
    screen, window = connection.setup.roots[0], connection.generate_id()
    values = [0xFFFFFF, 1]
    mask = xproto.CW.BackPixel | xproto.CW.OverrideRedirect
    kind = xproto.WindowClass.InputOutput
    connection.core.CreateWindowChecked(
        24, window, screen.root, 600, 400, 50, 50, 0, kind, screen.root_visual, mask, values
    ).check()
    connection.core.MapWindowChecked(window).check()
    assert not modulator.shows()
    modulator.show(symbols, LEVELS, 1, WAIT_S)
    np.testing.assert_array_equal(server.greys(), expected(symbols, profile, 31))
    assert modulator.shows()
    top = xproto.StackMode.Above
    connection.core.ConfigureWindowChecked(window, xproto.ConfigWindow.StackMode, [top]).check()
    assert not modulator.shows()
    connection.core.DestroyWindowChecked(window).check()
    until(lambda: bool((server.greys() == expected(symbols, profile, 31)).all()))  # the server repairs it
    connection.disconnect()


def test_a_monitor_of_another_resolution_is_refused(server: XServer, profile: Profile) -> None:
    settings = settings_of(server.display, rows_px=1080, columns_px=1920)
    modulator = ScreenModulator(settings, profile, LookupTable.linear(LEVELS))
    with pytest.raises(SourceError, match="got 1280x800 pixels, wanted 1920x1080 pixels, as the modulator has"):
        modulator.show(symbols_of(profile, 1), LEVELS, 1, WAIT_S)
    assert windows_of(os.getpid()) == []


def test_a_server_without_what_is_needed_is_refused(tmp_path: Path, profile: Profile) -> None:
    for options, got in ((("-extension", "RANDR"), "without the extension RANDR"), ((), "a colour depth of 16 bits")):
        depth = 24 if options else 16
        with x_server(tmp_path / str(depth), "-screen", "0", f"{COLUMNS}x{ROWS}x{depth}", *options) as server:
            modulator = ScreenModulator(settings_of(server.display), profile, LookupTable.linear(LEVELS))
            with pytest.raises(SourceError, match=got):
                modulator.open(WAIT_S)


def test_a_display_that_is_not_there_is_named(profile: Profile, monkeypatch: pytest.MonkeyPatch) -> None:
    modulator = ScreenModulator(settings_of(":4077.1"), profile, LookupTable.linear(LEVELS))
    with pytest.raises(SourceError, match=r"screen :4077\.1, monitor 0: .* X display :4077\.1 "):
        modulator.show(symbols_of(profile, 1), LEVELS, 1, WAIT_S)
    monkeypatch.delenv("DISPLAY", raising=False)
    settings = settings_of(":0").model_copy(update={"x_display": None})
    with pytest.raises(SourceError, match="no name of an X display"):
        ScreenModulator(settings, profile, LookupTable.linear(LEVELS)).open(WAIT_S)


def test_without_the_extra_it_is_named(profile: Profile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "xcffib.py").write_text("raise ModuleNotFoundError(\"No module named 'xcffib'\")")
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{ROOT}")
    modulator = ScreenModulator(settings_of(":0"), profile, LookupTable.linear(LEVELS))
    with pytest.raises(SourceError, match=r"No module named 'xcffib', wanted the screen extra"):
        modulator.open(WAIT_S)


def test_a_display_without_a_name_is_that_of_the_environment(
    server: XServer, profile: Profile, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DISPLAY", server.display)
    settings = settings_of(":0").model_copy(update={"x_display": None})
    modulator = ScreenModulator(settings, profile, LookupTable.linear(LEVELS))
    assert server.display in modulator.name
    modulator.show(symbols_of(profile, 1), LEVELS, 1, WAIT_S)
    assert server.greys().any()
    modulator.close()


def test_a_killed_window_loses_one_page_and_is_opened_again(
    server: XServer, modulator: ScreenModulator, profile: Profile
) -> None:
    symbols = symbols_of(profile, 2)
    modulator.show(symbols, LEVELS, 2, WAIT_S)
    os.kill(first := own_window(), signal.SIGKILL)
    until(lambda: not runs(first))
    assert not modulator.shows()
    assert "has ended" in lost(modulator, profile)
    modulator.show(symbols, LEVELS, 2, WAIT_S)
    np.testing.assert_array_equal(server.greys(), expected(symbols, profile, 31))
    assert own_window() != first


def test_a_window_that_hangs_loses_the_page_in_time(
    server: XServer, modulator: ScreenModulator, profile: Profile
) -> None:
    modulator.show(symbols_of(profile, 2), LEVELS, 2, WAIT_S)
    os.kill(own_window(), signal.SIGSTOP)
    assert "nothing on display after 0.3 s" in lost(modulator, profile, 0.3)
    modulator.show(symbols_of(profile, 2), LEVELS, 2, WAIT_S)
    os.kill(own_window(), signal.SIGSTOP)
    assert not modulator.shows()
    assert "has ended" in lost(modulator, profile)
    modulator.show(symbols_of(profile, 2), LEVELS, 2, WAIT_S)


def test_a_window_that_is_slow_to_open_is_waited_for_by_the_next_page(
    server: XServer, modulator: ScreenModulator, profile: Profile
) -> None:
    assert "not open yet" in lost(modulator, profile, 0.001)
    first = own_window()
    modulator.show(symbols_of(profile, 2), LEVELS, 2, WAIT_S)
    assert own_window() == first


def test_a_lost_server_loses_pages_until_it_is_back(tmp_path: Path, profile: Profile) -> None:
    options = ("-screen", "0", f"{COLUMNS}x{ROWS}x24")
    with x_server(tmp_path / "first", *options) as server:
        modulator = ScreenModulator(settings_of(server.display), profile, LookupTable.linear(LEVELS))
        modulator.show(symbols_of(profile, 2), LEVELS, 2, WAIT_S)
        window = own_window()
    assert not modulator.shows()
    until(lambda: not runs(window))
    assert "has ended" in lost(modulator, profile)
    assert f"X display {server.display} " in lost(modulator, profile)
    with x_server(tmp_path / "second", *options) as again:
        modulator._settings = settings_of(again.display)  # the number of the new server
        modulator.show(symbols := symbols_of(profile, 2), LEVELS, 2, WAIT_S)
        np.testing.assert_array_equal(again.greys(), expected(symbols, profile, 0))
        modulator.close()


PARENT = """
import sys
import numpy as np
from runtime.modulator.lookup_table import LookupTable
from runtime.modulator.screen import ScreenModulator
from runtime.modulator.settings import ScreenSettings
from tests.lightpage.small import small_profile
profile = small_profile()
settings = ScreenSettings.model_validate_json(sys.argv[1])
modulator = ScreenModulator(settings, profile, LookupTable.linear(2))
modulator.show(np.zeros(profile.page_shape, np.uint8), 2, 1, 30)
print("shown", flush=True)
sys.stdin.read()
"""


@pytest.mark.parametrize("ending", [signal.SIGKILL, signal.SIGINT, None])
def test_the_window_ends_with_the_process_that_opened_it(
    ending: signal.Signals | None, server: XServer, profile: Profile
) -> None:
    arguments = [sys.executable, "-c", PARENT, settings_of(server.display).model_dump_json()]
    with subprocess.Popen(
        arguments, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as parent:
        try:
            assert parent.stdout is not None
            assert parent.stdout.readline() == "shown\n"
            (window,) = windows_of(parent.pid)
            assert server.greys().any()
            if ending is None:
                parent.communicate(timeout=WAIT_S)
            else:
                parent.send_signal(ending)
                parent.wait(WAIT_S)
        finally:
            parent.kill()
    until(lambda: not runs(window))
    until(lambda: not server.picture().any())


def test_closing_takes_the_page_off_and_the_next_one_opens_again(
    server: XServer, modulator: ScreenModulator, profile: Profile
) -> None:
    assert not modulator.shows()
    modulator.close()
    modulator.show(symbols_of(profile, 1), LEVELS, 1, WAIT_S)
    modulator.close()
    assert not modulator.shows()
    assert windows_of(os.getpid()) == []
    until(lambda: not server.picture().any())
    modulator.show(symbols_of(profile, 1), LEVELS, 1, WAIT_S)
    assert modulator.shows()


def test_a_page_that_is_not_the_devices_is_not_shown(
    server: XServer, modulator: ScreenModulator, profile: Profile
) -> None:
    symbols = symbols_of(profile, 1)
    with pytest.raises(PageError, match="shape"):
        modulator.show(symbols[1:], LEVELS, 1, WAIT_S)
    with pytest.raises(PageError, match="8 levels, wanted 16 levels"):
        modulator.show(symbols % 8, 8, 1, WAIT_S)
    assert windows_of(os.getpid()) == []


def test_nothing_but_the_windows_process_loads_what_talks_to_the_x_server() -> None:
    code = "import sys, runtime.modulator.screen; print('xcffib' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == "False", done.stderr
