"""Network addresses as users write them."""

from __future__ import annotations

import errno
import re
import socket

from lightpage.errors import InvalidInputError

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


def check_free(name: str, address: str) -> None:
    """Check that this machine can listen at HOST:PORT: gRPC prints lines of its own and does not say why it cannot.

    Raises:
        InvalidInputError: it cannot; the message says why.
    """
    if address.startswith("unix:"):
        return
    host, _, port = address.rpartition(":")
    try:
        family, kind, protocol, _, where = socket.getaddrinfo(host.strip("[]"), int(port), type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as gRPC does: a port just left is free
            probe.bind(where)
            probe.listen(1)
    except (OSError, UnicodeError) as error:
        code, text = getattr(error, "errno", None), getattr(error, "strerror", None)
        if code == errno.EAFNOSUPPORT:
            return  # without IPv6, gRPC takes [::] for 0.0.0.0
        raise InvalidInputError(f"{name} {address}", text or error, "a free HOST:PORT of this machine") from None
