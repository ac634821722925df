"""A private network for a process: loopback alone, with the two addresses that two fake cameras need.

    python -m lightpage.virtual_device.namespace COMMAND ...

Linux only. Nothing outside the process sees the network, and it ends with the process.
"""

from __future__ import annotations

import fcntl
import functools
import os
import shutil
import socket
import struct
import subprocess
import sys
from collections.abc import Sequence

from lightpage.errors import SourceError

INSIDE = "LIGHTPAGE_PRIVATE_NETWORK"
"""Environment variable that is 1 in a private network."""
ADDRESSES = ("127.0.0.1", "127.0.0.2")
"""Addresses of the in-phase and the quadrature camera."""
_SUBJECT = "private network"
_EXPECTED = "Linux that lets this user make one (unshare --net, with --user --map-root-user for other users than root)"
_SIOCSIFFLAGS, _SIOCSIFADDR, _SIOCSIFNETMASK = 0x8914, 0x8916, 0x891C
_IFF_UP_RUNNING = 0x1 | 0x40
_TRY_S = 20.0


@functools.cache
def available() -> str | None:
    """Return why this machine lets the process make no private network, or None where it does; asked once."""
    if shutil.which("unshare") is None:
        return "no unshare (package util-linux)"
    try:
        run = subprocess.run(
            enter([sys.executable, "-c", ""]), stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=_TRY_S
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return str(error)
    return None if run.returncode == 0 else (run.stderr.strip() or f"exit code {run.returncode}").splitlines()[-1]


def enter(argv: Sequence[str]) -> list[str]:
    """The command line that becomes `argv` in a private network: signals to its process reach `argv`."""
    user = [] if os.geteuid() == 0 else ["--user", "--map-root-user"]
    inside = [sys.executable, "-m", "lightpage.virtual_device.namespace", *argv]
    return ["unshare", *user, "--net", "--", *inside]


def go_on_inside(module: str) -> None:
    """Become `python -m MODULE` with this process's arguments in a private network, unless this is one already.

    Raises:
        SourceError: the kernel forbids it.
    """
    if os.environ.get(INSIDE) == "1":
        return
    require()
    argv = enter([sys.executable, "-m", module, *sys.argv[1:]])
    os.execvpe(argv[0], argv, {**os.environ, INSIDE: "1"})


def require() -> None:
    """Raise unless a private network can be made.

    Raises:
        SourceError: with the reason.
    """
    if (reason := available()) is not None:
        raise SourceError(_SUBJECT, reason, _EXPECTED)


def set_up() -> None:
    """Switch loopback on, with every one of `ADDRESSES`; inside the private network.

    Raises:
        SourceError: the kernel forbids it.
    """
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
            for number, address in enumerate(ADDRESSES):
                name = b"lo" if number == 0 else f"lo:{number}".encode()
                fcntl.ioctl(line, _SIOCSIFADDR, _request(name, address))
                fcntl.ioctl(line, _SIOCSIFNETMASK, _request(name, "255.0.0.0"))
                fcntl.ioctl(line, _SIOCSIFFLAGS, struct.pack("16sH14x", name, _IFF_UP_RUNNING))
    except OSError as error:
        raise SourceError(f"{_SUBJECT}: loopback", error, _EXPECTED) from None


def _request(name: bytes, address: str) -> bytes:
    """A struct ifreq with an address."""
    return struct.pack("16sHH4s8x", name, socket.AF_INET, 0, socket.inet_aton(address))


def main(argv: Sequence[str]) -> None:
    """Set the network up and become `argv`; only inside a private one, for it changes loopback."""
    try:
        if {name for _, name in socket.if_nameindex()} - {"lo"}:
            raise SourceError(_SUBJECT, "a network with other interfaces than loopback", "one that is private")
        set_up()
    except SourceError as error:
        sys.exit(str(error))
    os.execvp(argv[0], list(argv))


if __name__ == "__main__":
    main(sys.argv[1:])
