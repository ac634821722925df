"""Network addresses as users write them."""

from __future__ import annotations

import re

from optics.errors import InvalidInputError

_HOST_PORT = re.compile(r"(\[[0-9a-fA-F:.]+\]|[^\s:/\[\]]+):(\d{1,5})")
_LARGEST_PORT = 65535


def check_address(name: str, address: str, least_port: int = 1) -> None:
    """Check that an address is HOST:PORT (or unix:PATH): gRPC would guess a port, or take one modulo 65,536.

    Raises:
        InvalidInputError: it is not.
    """
    if address.startswith("unix:"):
        return
    match = _HOST_PORT.fullmatch(address)
    if match is None or not least_port <= int(match[2]) <= _LARGEST_PORT:
        raise InvalidInputError(name, repr(address), f"HOST:PORT with a port from {least_port} to {_LARGEST_PORT}")
