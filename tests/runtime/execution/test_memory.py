"""Whether threads share the memory that each of them frees."""

from __future__ import annotations

import ctypes
import platform
import subprocess
import sys

import pytest

from runtime.execution.memory import share_freed_memory
from tests.skips import NO_GLIBC

_PROGRAM = """
import ctypes, sys, threading
from runtime.execution.memory import share_freed_memory
if {shared}:
    assert share_freed_memory()
libc = ctypes.CDLL(None)
libc.malloc.restype = libc.fdopen.restype = ctypes.c_void_p
together = threading.Barrier(6)
def take():
    together.wait(30)
    libc.malloc(1000)
    together.wait(30)
threads = [threading.Thread(target=take) for _ in range(6)]
[thread.start() for thread in threads]
[thread.join() for thread in threads]
libc.malloc_info(0, ctypes.c_void_p(libc.fdopen(2, b"w")))
libc.fflush(None)
"""


def _arenas(shared: bool) -> int:
    """Places that six threads, which live at the same time, take memory from."""
    program = _PROGRAM.format(shared=shared)
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=True)
    return done.stderr.count("<heap nr=")


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason=NO_GLIBC)
def test_many_threads_take_memory_from_two_places() -> None:
    assert _arenas(shared=False) > 2
    assert _arenas(shared=True) <= 2


def test_another_c_library_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ctypes, "CDLL", lambda name: object())
    assert not share_freed_memory()
