"""How a client gets a region of memory that it shares with the service: a socket beside the service's own.

The client connects to the socket and sends how many bytes it wants, as 8 bytes, little-endian. The answer is a byte: 0,
then the region's handle, with a file descriptor of the region beside it (SCM_RIGHTS); or 1, then why there is none, in
UTF-8. The region lives until the connection ends.
"""

from __future__ import annotations

import struct

SUFFIX = ".memory"
"""Behind the path of the service's socket, the path of this one."""
SIZE = struct.Struct("<Q")
HANDLE_BYTES = 32
GRANTED, REFUSED = b"\0", b"\1"
WHY_BYTES = 1000
"""Of a refusal's text, at most."""


def memory_path(address: str) -> str:
    """Path of the socket that goes with a service at ``unix:PATH``."""
    return address.removeprefix("unix:") + SUFFIX
