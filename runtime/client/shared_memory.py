"""A region of memory that a client shares with a service on the same machine: frames in it need not be sent.

A socket beside the service's own gives it out. The client connects to it and sends how many bytes it wants, as 8 bytes,
little-endian. The answer is a byte: 0, then the region's handle, with a file descriptor of the region beside it
(SCM_RIGHTS); or 1, then why there is none, in UTF-8. The region lives until the connection ends.
"""

import mmap
import os
import socket
import struct
from typing import Self

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import InvalidInputError, LightpageError
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.client.wire.address import check_socket_path

SUFFIX = ".memory"
"""Behind the path of the service's socket, the path of this one."""
SIZE = struct.Struct("<Q")
HANDLE_BYTES = 32
GRANTED, REFUSED = b"\0", b"\1"
WHY_BYTES = 1000
"""Of a refusal's text, at most."""

_ANSWER_S = 10.0


def memory_path(address: str) -> str:
    """Path of the socket that goes with a service at ``unix:PATH``."""
    return address.removeprefix("unix:") + SUFFIX


class SharedMemory:
    """A region of a service's memory; use it in a `with` statement, or `close` it. Then the service lets go of it.

    A pair is written to it, or straight from a camera into `frames`, and decoded by `Frames.decode`. While a
    call with it is on its way, its contents must stay.

    Args:
        target: ``unix:PATH`` of the service.
        size: bytes.

    Raises:
        InvalidInputError: no Unix socket.
        LightpageError: the service offers no memory, or not as much.
    """

    def __init__(self, target: str, size: int) -> None:
        if not target.startswith("unix:") or not hasattr(socket, "AF_UNIX"):
            raise InvalidInputError("target of shared memory", target, "unix:PATH: memory is shared on one machine")
        check_socket_path("socket of shared memory", memory_path(target))
        if not 0 < size < 1 << 63:
            raise InvalidInputError("size of shared memory", size, "1 to 2^63 - 1 bytes")
        subject, expected = f"shared memory of {target}", "a service that was started with --shared-memory"
        self.size = size
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.settimeout(_ANSWER_S)
        descriptors: list[int] = []
        try:
            self._socket.connect(memory_path(target))
            self._socket.sendall(SIZE.pack(size))
            answer, descriptors, _, _ = socket.recv_fds(self._socket, 1 + max(HANDLE_BYTES, WHY_BYTES), 1)
            if answer[:1] != GRANTED or len(answer) != 1 + HANDLE_BYTES or len(descriptors) != 1:
                raise LightpageError(subject, answer[1:].decode("utf-8", "replace") or "no answer", "a region")
            self.handle = answer[1:]
            self._memory = mmap.mmap(descriptors[0], size)
        except (OSError, ValueError, OverflowError) as error:
            self._socket.close()
            raise LightpageError(subject, error, expected) from None
        except BaseException:
            self._socket.close()
            raise
        finally:
            for descriptor in descriptors:
                os.close(descriptor)

    def frames(self, shape: tuple[int, int], dtype: np.dtype[np.integer] | str, offset: int = 0) -> FramePair:
        """Two frames in the region, to be filled: in-phase at `offset`, quadrature behind it.

        Raises:
            InvalidInputError: the region is too small.
        """
        kind = np.dtype(dtype).newbyteorder("<")
        count = shape[0] * shape[1]
        if offset < 0 or offset + 2 * count * kind.itemsize > self.size:
            expected = f"two frames of {shape[0]}x{shape[1]} {kind.name} within {self.size} bytes"
            raise InvalidInputError("offset", offset, expected)
        both: NDArray[np.integer] = np.frombuffer(self._memory, kind, 2 * count, offset)
        in_phase, quadrature = both.reshape(2, *shape)
        return FramePair(in_phase, quadrature)

    def write(self, pair: FramePair) -> int:
        """Write a pair to the region's begin, unless it lies in the region one frame behind the other.

        Returns its offset. What lay in its place is overwritten, frames of the pair itself too.

        Raises:
            InvalidInputError: the region is too small.
        """
        in_phase, quadrature = np.asarray(pair.in_phase), np.asarray(pair.quadrature)
        offset = in_phase.ctypes.data - np.frombuffer(self._memory, np.uint8).ctypes.data
        whole = in_phase.flags.c_contiguous and quadrature.flags.c_contiguous
        follows = quadrature.ctypes.data - in_phase.ctypes.data == in_phase.nbytes
        if whole and follows and 0 <= offset <= self.size - 2 * in_phase.nbytes:
            return offset
        frames = self.frames((in_phase.shape[0], in_phase.shape[1]), in_phase.dtype)
        if np.may_share_memory(frames.in_phase, quadrature):  # which goes second
            quadrature = quadrature.copy()
        frames.in_phase[...], frames.quadrature[...] = in_phase, quadrature
        return 0

    def close(self) -> None:
        """Have the service let go of it. Frames in it that are still held stay readable."""
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
