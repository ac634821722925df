"""Modulator and shutters of a simulated device, over the Unix socket on which it listens.

A message is a line of JSON, followed by the page's symbols where it shows one. A third kind lets the device drift: it
has the true state that it drifts to, as TOML. Each is answered by a line of JSON, once
the page is on display or the shutters have moved; an answer with `error` says why not.
"""

from __future__ import annotations

import json
import logging
from multiprocessing.connection import Client, Connection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.device.profile import to_toml
from lightpage.device.state import Device
from lightpage.errors import LightpageError, LostShotError, Reason, SourceError

_log = logging.getLogger(__name__)

ANSWER_S = 30.0
"""Longest wait for shutters. A full-size page takes minutes to simulate, but it has the wait of its shot."""


class SimulatedModulator:
    """Satisfies `Modulator` and `Beams`.

    Args:
        address: address of the simulated device's socket.
    """

    def __init__(self, address: Path) -> None:
        self._address = address
        self._connection: Connection[Any, Any] | None = None
        self._was_there = False
        self._blocks = False
        self.name = f"simulated modulator {address.name}"

    def open(self, timeout_s: float, levels: int | None = None) -> None:
        """See `Modulator`."""
        self._connected(Reason.NOT_ON_DISPLAY)

    def show(self, symbols: NDArray[np.uint8], levels: int, page: int, timeout_s: float) -> None:
        """See `Modulator`."""
        head = {"levels": levels, "shape": symbols.shape, "page": page}
        self._ask(head, symbols.tobytes(), timeout_s, Reason.NOT_ON_DISPLAY)

    def shows(self) -> bool:
        """See `Modulator`."""
        return self._connection is not None

    def let_through(self, *, signal: bool, reference: bool) -> None:
        """See `Beams`."""
        self._blocks = True
        self._ask({"signal": signal, "reference": reference}, b"", ANSWER_S, Reason.BEAM_CONTROL_FAILED)
        self._blocks = not (signal and reference)

    def drift(self, device: Device) -> None:
        """Let the simulated device drift to another true state; the next page that is shown shows it.

        Raises:
            LostShotError: the device has gone.
            SourceError: there is none.
        """
        self._ask({"device": to_toml(device)}, b"", ANSWER_S, Reason.NOT_ON_DISPLAY)

    def close(self) -> None:
        """See `Modulator` and `Beams`."""
        if self._blocks and self._was_there:
            try:
                self.let_through(signal=True, reference=True)
            except LightpageError as error:
                _log.warning("beams may still be blocked: %s", error)
        self._hang_up()

    def _hang_up(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()

    def _ask(self, head: dict[str, Any], content: bytes, timeout_s: float, reason: Reason) -> None:
        connection = self._connected(reason)
        try:
            connection.send_bytes(json.dumps(head).encode() + b"\n" + content)
            if not connection.poll(timeout_s):
                raise LostShotError(self.name, f"no answer within {timeout_s:.1f} s", "an answer", reason)
            answer = json.loads(connection.recv_bytes(1 << 16))
        except (OSError, EOFError, ValueError) as error:
            self._hang_up()
            raise LostShotError(self.name, error or "no connection", "a simulated device", reason) from None
        except LostShotError:
            self._hang_up()  # what comes later is no answer to anything else
            raise
        if "error" in answer:
            raise LostShotError(self.name, answer["error"], "a page on display, and shutters that moved", reason)

    def _connected(self, reason: Reason) -> Connection[Any, Any]:
        """The connection. A device that was never there is not one that has gone away."""
        if self._connection is None:
            try:
                self._connection = Client(str(self._address), "AF_UNIX")
            except OSError as error:
                expected = f"the socket of a simulated device that runs, {self._address}"
                if self._was_there:
                    raise LostShotError(self.name, error, expected, reason) from None
                raise SourceError(self.name, error, expected) from None
            self._was_there = True
        return self._connection
