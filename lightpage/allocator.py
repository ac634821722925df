"""Options of the C library's memory, by mallopt(3)."""

from __future__ import annotations

import ctypes


def set_options(*options: tuple[int, int]) -> bool:
    """Set options of glibc's malloc, each a number from its malloc.h and a value.

    Returns:
        Whether the C library could be told: only glibc can.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # the last on Windows
        return False
    return all([mallopt(number, value) for number, value in options])
