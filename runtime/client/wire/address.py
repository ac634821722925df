"""Network addresses as users write them."""

import errno
import ipaddress
import os
import re
import socket
from collections.abc import Collection
from pathlib import Path

from lightpage.errors import InvalidInputError
from lightpage.temporary import SOCKET_BYTES

_HOST_PORT = re.compile(r"(\[[0-9a-fA-F:.]+\]|[^\s:/\[\]]+):([0-9]{1,5})")
_UNIX = "unix:"
_LARGEST_PORT = 65535
_ANSWER_S = 1.0


def is_local(address: str) -> bool:
    """Return whether nobody beyond this machine can reach an address (HOST:PORT, HOST or unix:PATH)."""
    if address.startswith(_UNIX):
        return True
    host = (match[1] if (match := _HOST_PORT.fullmatch(address)) else address).strip("[]")
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def host_and_port(host: str, port: int | str) -> str:
    """HOST:PORT; an IPv6 address goes into brackets if it has none."""
    return f"[{host}]:{port}" if ":" in host and not host.startswith("[") else f"{host}:{port}"


def target_of(address: str, port: int) -> str:
    """Return the target of a client on this machine for a listener at HOST:PORT or unix:PATH that got a port."""
    if address.startswith(_UNIX):
        return address
    host = address.rpartition(":")[0]
    return f"{'127.0.0.1' if host in ('0.0.0.0', '[::]', '') else host}:{port}"


def names_machine(host: str, known: Collection[str]) -> bool:
    """Return whether a request's ``Host`` names this machine in a way that no stranger can choose.

    A page of a stranger may have its own name resolve to this machine (DNS rebinding), and then reads what is served
    there as if it were its own. An IP address, `localhost`, and names that somebody gave this service are not
    of that kind.

    Args:
        host: HOST or HOST:PORT.
        known: names beside those, in lower case; ``*.NAME`` stands for all one label below NAME.
    """
    name = host.rpartition("]")[0].lstrip("[") if host.startswith("[") else host.partition(":")[0]
    name = name.lower().removesuffix(".")
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return f".{name}".endswith(".localhost") or not {name, f"*.{name.partition('.')[2]}"}.isdisjoint(known)
    return True


def check_address(name: str, address: str, least_port: int = 1) -> None:
    """Check that an address is HOST:PORT (or unix:PATH): gRPC would guess a port, or take one modulo 65,536.

    Raises:
        InvalidInputError: it is not.
    """
    if address.startswith(_UNIX):
        if not (path := address.removeprefix(_UNIX)):
            raise InvalidInputError(name, repr(address), "unix:PATH, or HOST:PORT")
        check_socket_path(name, path)
        return
    match = _HOST_PORT.fullmatch(address)
    if match is None or not least_port <= int(match[2]) <= _LARGEST_PORT:
        raise InvalidInputError(name, repr(address), f"HOST:PORT with a port from {least_port} to {_LARGEST_PORT}")


def check_socket_path(name: str, path: str) -> None:
    """Check that a Unix socket can have a path.

    Raises:
        InvalidInputError: it is too long for the system.
    """
    if (size := len(os.fsencode(path))) > SOCKET_BYTES:
        expected = f"a path of at most {SOCKET_BYTES} bytes for a Unix socket; a relative one may be shorter"
        raise InvalidInputError(name, f"{path}, {size} bytes", expected)


def check_free(name: str, address: str) -> None:
    """Check that this machine can listen at HOST:PORT: gRPC prints lines of its own and does not say why it cannot.

    Raises:
        InvalidInputError: it cannot; the message says why.
    """
    if address.startswith(_UNIX):
        _check_socket_free(f"{name} {address}", address.removeprefix(_UNIX))
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


def _check_socket_free(subject: str, path: str) -> None:
    """Check that no process listens at a socket: gRPC would take it away from one that does."""
    check_socket_path(subject, path)
    folder, at = Path(path).parent, Path(path)
    if not folder.is_dir():
        raise InvalidInputError(subject, f"no folder {folder}", "a socket's path in a folder that is there")
    if not os.access(folder, os.W_OK):
        raise InvalidInputError(subject, f"a folder {folder} that cannot be written", "one where a socket can be made")
    if not at.exists():
        return
    if not at.is_socket():
        raise InvalidInputError(subject, "something that is no socket", "a free path, or a socket that was left behind")
    with socket.socket(socket.AF_UNIX) as probe:
        probe.settimeout(_ANSWER_S)
        try:
            probe.connect(path)
        except ConnectionRefusedError:
            return  # left behind by a process that was killed; gRPC replaces it
        except OSError as error:
            raise InvalidInputError(subject, error.strerror or error, "a socket that can be replaced") from None
    raise InvalidInputError(subject, "a process that listens there", "a free path")
