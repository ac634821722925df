"""The socket on which a simulated device takes pages to show and orders for its shutters."""

from __future__ import annotations

import json
import logging
import threading
from multiprocessing.connection import Connection, Listener
from pathlib import Path
from typing import Any, Self

import numpy as np

from lightpage.device.state import parse_device
from lightpage.errors import LightpageError, PageError
from lightpage.temporary import SOCKET_BYTES
from lightpage.virtual_device.light import Light

_log = logging.getLogger(__name__)

_MESSAGE_BYTES = 1 << 24
"""Largest message: a page of four million symbols."""
_POLL_S = 0.2


class ModulatorSocket:
    """Listens on a Unix socket, one driver at a time; see its other end, `SimulatedModulator`, for what is said.

    Args:
        light: light in which the pages are shown.
        address: address of the socket, which is made.

    Raises:
        LightpageError: the address cannot be listened on.
    """

    def __init__(self, light: Light, address: Path) -> None:
        self._light = light
        try:
            self._listener = Listener(str(address), "AF_UNIX")
        except OSError as error:
            expected = f"a path of at most {SOCKET_BYTES} bytes for a new socket, where the file system has sockets"
            raise LightpageError(f"modulator socket {address}", error, expected) from None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="virtual-modulator", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop listening; the socket goes."""
        self._stop.set()
        self._listener.close()

    def _serve(self) -> None:
        while not self._stop.is_set():
            try:
                connection = self._listener.accept()
            except (OSError, EOFError):
                return
            threading.Thread(target=self._talk, args=(connection,), name="virtual-modulator-talk", daemon=True).start()

    def _talk(self, connection: Connection[Any, Any]) -> None:
        with connection:
            while not self._stop.is_set():
                try:
                    if not connection.poll(_POLL_S):
                        continue
                    answer = self._answer(connection.recv_bytes(_MESSAGE_BYTES))
                    connection.send_bytes(json.dumps(answer).encode())
                except (OSError, EOFError):
                    return

    def _answer(self, message: bytes) -> dict[str, Any]:
        line, _, content = message.partition(b"\n")
        try:
            head = json.loads(line)
            if "levels" in head:
                shape = tuple(map(int, head["shape"]))
                if len(content) != int(np.prod(shape)):
                    raise PageError("page to show", f"{len(content)} symbols", f"{shape}")
                symbols = np.frombuffer(content, np.uint8).reshape(shape)
                self._light.show(symbols, int(head["levels"]), int(head["page"]))
            elif "device" in head:
                self._light.set_device(parse_device(head["device"]))
            else:
                self._light.let_through(signal=bool(head["signal"]), reference=bool(head["reference"]))
        except LightpageError as error:
            return {"error": str(error)}
        except (ValueError, KeyError, TypeError) as error:
            return {"error": f"a message that cannot be read: {error!r}"}
        return {}
