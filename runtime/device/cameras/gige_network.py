"""Questions to a GigE camera and to this machine's network beside the driver: quick, and without control."""

import os
import socket
import struct

from lightpage.errors import SourceError

PORT = 3956
"""Of GigE Vision's control protocol (GVCP)."""
CONTROL_PRIVILEGE = 0x0A00
"""Register that is 0 while nobody controls the camera."""
_READ_REGISTER, _READ_REGISTER_ANSWER, _ANSWER_REQUIRED = 0x0080, 0x0081, 0x01
_COMMAND = 0x42
_HEADER = struct.Struct(">BBHHH")
_IP_MTU = 14
"""Linux: MTU of a connected socket's route; the socket module has no name for it."""
LARGEST_PACKET = 65_000
"""Largest packet that is chosen without being asked for, below what one datagram of IP holds."""


def read_register(address: str, register: int, timeout_s: float = 0.2, tries: int = 3) -> int | None:
    """Ask a camera for a register, past the driver; None where it does not answer, and 0 where it refuses.

    Raises:
        SourceError: the address cannot be resolved.
    """
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
            line.settimeout(timeout_s)
            line.connect((address, PORT))
            for number in range(1, tries + 1):
                head = _HEADER.pack(_COMMAND, _ANSWER_REQUIRED, _READ_REGISTER, 4, number)
                try:
                    line.send(head + struct.pack(">I", register))
                    answer = line.recv(64)
                except OSError:  # timed out, or nobody listens there
                    continue
                if len(answer) >= _HEADER.size and _HEADER.unpack_from(answer)[2] == _READ_REGISTER_ANSWER:
                    return int(struct.unpack_from(">I", answer, _HEADER.size)[0]) if len(answer) >= 12 else 0
    except socket.gaierror as error:
        raise SourceError(f"camera address {address}", error, "an IP address or a host's name") from None
    except OSError:  # no route
        return None
    return None


def route_mtu(address: str) -> int:
    """Largest packet, in bytes, that this machine's network card sends to a camera."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
        line.connect((address, PORT))
        return min(line.getsockopt(socket.IPPROTO_IP, _IP_MTU), LARGEST_PACKET)


def receive_buffer_problem(frame_bytes: int) -> str:
    """Why frames of this size may lose packets here, and what to do about it; empty where nothing is wrong.

    The driver reads packets from the network card directly where it may; else they wait in a socket's buffer, which the
    kernel keeps below ``net.core.rmem_max``.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
        line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, frame_bytes)
        granted = line.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2  # the kernel says twice as much
    if granted >= frame_bytes or may_read_packets():
        return ""
    return (
        f"the kernel grants a socket {granted} bytes, and a frame has {frame_bytes}: packets may be lost; "
        f"sysctl -w net.core.rmem_max={frame_bytes}, or give this program CAP_NET_RAW"
    )


def may_read_packets() -> bool:
    """Return whether this program may read packets from the network card directly."""
    if not hasattr(socket, "AF_PACKET"):
        return False
    try:
        os.close(socket.socket(socket.AF_PACKET, socket.SOCK_RAW).detach())
    except OSError:
        return False
    return True
