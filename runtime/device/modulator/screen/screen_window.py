"""The process of a modulator's window, started by `window_process` with SETTINGS and a socket on its stdin.

It ends when the socket's other end does, whatever the X server keeps it waiting for.
"""

from __future__ import annotations

import os
import socket
import sys
import threading
from queue import Empty, SimpleQueue

from lightpage.errors import SourceError
from lightpage.helper_process import parent_link
from lightpage.runtime.device.modulator.screen.raster import ScreenSettings
from lightpage.runtime.device.modulator.screen.window_process import REQUEST, Answer

LOOK_S = 0.1
"""How often it looks at the X server's events without being asked."""

Requests = SimpleQueue[tuple[int, bytes | None]]
"""Number of each request, and the page to show with it."""


def main(settings_json: str) -> int:
    """Show what comes over the socket on stdin until its other end is closed."""
    settings = ScreenSettings.model_validate_json(settings_json)
    link = parent_link()
    requests: Requests = SimpleQueue()
    arguments = (link, settings.rows_px * settings.columns_px, requests)
    threading.Thread(target=_receive, args=arguments, daemon=True).start()
    try:
        return _serve(settings, link, requests)
    except OSError as error:
        print(f"window of the modulator: {error}", file=sys.stderr)
        return 1


def _receive(link: socket.socket, page_bytes: int, requests: Requests) -> None:
    """Take in requests; end the process behind the last one."""
    try:
        with link.makefile("rb") as stream:
            while len(head := stream.read(REQUEST.size)) == REQUEST.size:
                has_page, number = REQUEST.unpack(head)
                requests.put((number, stream.read(page_bytes) if has_page else None))
    finally:
        os._exit(0)


def _serve(settings: ScreenSettings, link: socket.socket, requests: Requests) -> int:
    try:
        import xcffib

        from lightpage.runtime.device.modulator.screen.x_window import XWindow
    except (ImportError, OSError) as error:
        expected = "the screen extra (pip install 'lightpage[screen]') and the library libxcb"
        link.sendall(Answer(number=0, got=str(error), expected=expected).to_line())
        return 1
    try:
        try:
            window = XWindow(settings)
        except SourceError as error:
            link.sendall(Answer(number=0, got=error.got, expected=error.expected).to_line())
            return 1
        link.sendall(Answer(number=0).to_line())
        while True:
            try:
                number, page = requests.get(timeout=LOOK_S)
            except Empty:
                window.look()
                continue
            if page is None:
                window.look()
            else:
                window.draw(page)
            link.sendall(Answer(number=number, shows=window.shows).to_line())
    except xcffib.XcffibException as error:
        print(f"window of the modulator: {error!r}", file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
