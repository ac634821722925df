"""A window over a whole monitor of an X server, for the process that owns it (`screen_window`).

Three requests are written here by hand, a picture and two of X's Present extension. xcffib leaves out what has a 64-bit
field, which is most of Present (its protocol is in the file presentproto.txt of xorgproto), and packs the pixels of
`PutImage` one by one: 60 ms for 1920x1080, against 3 ms as one piece.
"""

import io
import os
import struct
from typing import Any, NamedTuple

import numpy as np
import xcffib
from numpy.typing import NDArray
from xcffib import present, randr, screensaver, xproto

from lightpage.errors import SourceError
from lightpage.runtime.device.modulator.screen.raster import ScreenSettings

_ROWS_AT_ONCE = 64
"""A request of so many rows is below the limit of any server (16 MiB) for any modulator."""
_GREY = 0x010101
"""Pixel of red, green and blue 1."""


_PUT_IMAGE = 72
_PRESENT_PIXMAP, _NOTIFY_MSC = 1, 2
_COMPLETE_NOTIFY = 1


class CompleteNotifyEvent(xcffib.Event):
    """A pixmap was presented, or a refresh of the display has come.

    Attributes:
        kind: `present.CompleteKind`.
        serial: serial number of the request.
        msc: count of the display's refreshes.
    """

    xge = True
    event_number = _COMPLETE_NOTIFY

    def __init__(self, unpacker: Any) -> None:
        xcffib.Event.__init__(self, unpacker)
        self.kind, _mode, _event, _window, self.serial, _ust, self.msc = unpacker.unpack("=xx2xBBIIIQQ")


_events: dict[int, Any] = present._events
_events[_COMPLETE_NOTIFY] = CompleteNotifyEvent


class Monitor(NamedTuple):
    """Position of a monitor on the X server's screen, pixels."""

    x: int
    y: int
    columns: int
    rows: int

    def __str__(self) -> str:
        return f"{self.columns}x{self.rows}"


class XWindow:
    """A window without border and mouse pointer that no window manager moves, over one whole monitor.

    Args:
        settings: which monitor, and the modulator's resolution.

    Raises:
        SourceError: there is no such X server, screen or monitor, or it is not what a modulator needs.
    """

    def __init__(self, settings: ScreenSettings) -> None:
        self._settings = settings
        self._connection = _connect(settings)
        self._screen = self._connection.setup.roots[self._connection.pref_screen]
        self._check_server()
        self._monitor = self._check_monitor()
        self._serial = 0
        self._visible = False
        self._window, self._pixmap, self._context = self._open()
        self._keep_awake()

    @property
    def shows(self) -> bool:
        """Return whether nothing covers the window, and its monitor is where and what it was."""
        return self._visible and self._find_monitor() == self._monitor

    def draw(self, image: NDArray[np.uint8]) -> None:
        """Show a picture, and return once the display has scanned it out once.

        The server copies the picture to the window at a refresh and says so. What covers the window is put below it.

        Args:
            image: grey values [row, column].
        """
        columns = self._monitor.columns
        pixels = image.repeat(4).tobytes()
        strip = _ROWS_AT_ONCE * columns * 4
        for start in range(0, len(pixels), strip):
            self._put_rows(start // (4 * columns), pixels[start : start + strip])
        core = self._connection.core
        # With this the server itself repairs what something has covered for a while.
        core.ChangeWindowAttributes(self._window, xproto.CW.BackPixmap, [self._pixmap])
        core.ConfigureWindow(self._window, xproto.ConfigWindow.StackMode, [xproto.StackMode.Above])
        self._serial += 1
        self._present()
        shown = self._complete(present.CompleteKind.Pixmap)
        self._notify_at(shown.msc + 1)
        self._complete(present.CompleteKind.NotifyMSC)

    def look(self) -> None:
        """Take note of what the server has said meanwhile."""
        while (event := self._connection.poll_for_event()) is not None:
            self._note(event)

    def _put_rows(self, row: int, pixels: bytes) -> None:
        """Draw whole rows of 32-bit pixels into the pixmap, from `row` on."""
        columns, depth = self._monitor.columns, self._screen.root_depth
        place = self._pixmap, self._context, columns, len(pixels) // (4 * columns), 0, row
        head = struct.pack("=xB2xIIHHhhBB2x", xproto.ImageFormat.ZPixmap, *place, 0, depth)
        self._connection.core.send_request(_PUT_IMAGE, io.BytesIO(head + pixels))

    def _present(self) -> None:
        """Copy the pixmap to the window at the display's next refresh; a `CompleteNotifyEvent` says when."""
        whole = 7 * (0,)  # no regions, offset, output or fences
        options, target, divisor, remainder = present.Option.Copy, 0, 0, 0
        what = self._window, self._pixmap, self._serial, *whole, options, target, divisor, remainder
        request = struct.pack("=xx2xIIIIIhhIIII4xQQQ", *what)
        self._connection(present.key).send_request(_PRESENT_PIXMAP, io.BytesIO(request))

    def _notify_at(self, msc: int) -> None:
        """Ask for a `CompleteNotifyEvent` at refresh number `msc`."""
        request = struct.pack("=xx2xII4xQQQ", self._window, self._serial, msc, 0, 0)
        self._connection(present.key).send_request(_NOTIFY_MSC, io.BytesIO(request))

    def _complete(self, kind: int) -> CompleteNotifyEvent:
        """Wait for the server's word that the last request of this kind is done."""
        self._connection.flush()
        while True:
            event = self._connection.wait_for_event()
            self._note(event)
            if isinstance(event, CompleteNotifyEvent) and (event.kind, event.serial) == (kind, self._serial):
                return event

    def _note(self, event: Any) -> None:
        if isinstance(event, xproto.VisibilityNotifyEvent):
            self._visible = event.state == xproto.Visibility.Unobscured
        elif isinstance(event, (xproto.UnmapNotifyEvent, xproto.DestroyNotifyEvent)):
            self._visible = False

    def _check_server(self) -> None:
        screen = self._screen
        bits = {form.depth: form.bits_per_pixel for form in self._connection.setup.pixmap_formats}
        if (depth := (screen.root_depth, bits[screen.root_depth])) != (24, 32):
            raise SourceError("screen", f"a depth of {depth[0]} bits in {depth[1]}", "24 in 32: 8 bits of each colour")
        for extension in (randr.key, present.key):
            if not self._connection.core.QueryExtension(len(extension.name), extension.name).reply().present:
                raise SourceError("screen", "an X server without the extension " + extension.name, "one with it")
        self._connection(randr.key).QueryVersion(1, 5).reply()
        self._connection(present.key).QueryVersion(1, 0).reply()

    def _monitors(self) -> list[Monitor]:
        reply = self._connection(randr.key).GetMonitors(self._screen.root, True).reply()
        return [Monitor(m.x, m.y, m.width, m.height) for m in reply.monitors]

    def _find_monitor(self) -> Monitor | None:
        monitors = self._monitors()
        return monitors[self._settings.monitor] if self._settings.monitor < len(monitors) else None

    def _check_monitor(self) -> Monitor:
        """The monitor, which must have the modulator's pixels: what has others is scaled on its way."""
        if (monitor := self._find_monitor()) is None:
            sizes = ", ".join(f"{which} of {there} pixels" for which, there in enumerate(self._monitors()))
            got = f"monitors {sizes}" if sizes else "no monitor at all"
            raise SourceError("screen", got, f"monitor {self._settings.monitor}")
        if (monitor.rows, monitor.columns) != (self._settings.rows_px, self._settings.columns_px):
            raise SourceError(
                "screen",
                f"{monitor} pixels",
                f"{self._settings.columns_px}x{self._settings.rows_px} pixels, as the modulator has: "
                "set the monitor's mode to them, or columns_px and rows_px to the monitor's",
            )
        return monitor

    def _open(self) -> tuple[int, int, int]:
        """Make the window, the pixmap to draw in and its graphics context."""
        connection, core, monitor, screen = self._connection, self._connection.core, self._monitor, self._screen
        window, pixmap, context, events = (connection.generate_id() for _ in range(4))
        mask, selected = xproto.CW, xproto.EventMask
        attributes = mask.BackPixel | mask.OverrideRedirect | mask.EventMask | mask.Cursor
        seen = selected.StructureNotify | selected.VisibilityChange
        values = [self._settings.background_grey * _GREY, 1, seen, self._no_pointer()]
        of, kind = (screen.root_depth, window, screen.root), xproto.WindowClass.InputOutput
        core.CreateWindowChecked(*of, *monitor, 0, kind, screen.root_visual, attributes, values).check()
        core.CreatePixmapChecked(screen.root_depth, pixmap, window, monitor.columns, monitor.rows).check()
        core.CreateGCChecked(context, pixmap, 0, []).check()
        connection(present.key).SelectInputChecked(events, window, present.EventMask.CompleteNotify).check()
        core.MapWindowChecked(window).check()
        return window, pixmap, context

    def _no_pointer(self) -> int:
        """A mouse pointer of one pixel that is not drawn."""
        core = self._connection.core
        bitmap, context, cursor = (self._connection.generate_id() for _ in range(3))
        core.CreatePixmapChecked(1, bitmap, self._screen.root, 1, 1).check()
        core.CreateGCChecked(context, bitmap, xproto.GC.Foreground, [0]).check()
        core.PolyFillRectangleChecked(bitmap, context, 1, [xproto.RECTANGLE.synthetic(0, 0, 1, 1)]).check()
        core.CreateCursorChecked(cursor, bitmap, bitmap, 0, 0, 0, 0, 0, 0, 0, 0).check()
        return int(cursor)

    def _keep_awake(self) -> None:
        """Hold back screen saver and power saving; the server does so no longer when this process ends."""
        name = screensaver.key.name
        if self._connection.core.QueryExtension(len(name), name).reply().present:
            saver = self._connection(screensaver.key)
            saver.QueryVersion(1, 1).reply()
            saver.SuspendChecked(1).check()


def _connect(settings: ScreenSettings) -> Any:
    display = settings.x_display or os.environ.get("DISPLAY", "")
    if not display:
        raise SourceError("screen", "no name of an X display", "one in x_display, or in the variable DISPLAY")
    try:
        return xcffib.connect(display)
    except xcffib.ConnectionException as error:
        got = f"no connection to X display {display} ({str(error).rstrip('.')})"
        raise SourceError("screen", got, "an X server that runs and lets this user in") from None
