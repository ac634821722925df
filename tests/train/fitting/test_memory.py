"""Whether freed memory stays with the process that asks for it."""

from __future__ import annotations

import ctypes
import platform
import subprocess
import sys

import pytest

from tests.skips import NO_GLIBC
from train.fitting.memory import keep_freed_memory

_PROGRAM = """
import numpy, resource
from train.fitting.memory import keep_freed_memory
if {keep}:
    assert keep_freed_memory()
def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(5):
        numpy.full(1 << 23, 1.0)  # 64 MiB
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
faults()
print(faults())
"""


def _faults(keep: bool) -> int:
    """Pages that the system handed out, filled with zeros, to five large arrays behind five others."""
    return int(subprocess.check_output([sys.executable, "-c", _PROGRAM.format(keep=keep)], text=True, timeout=120))


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason=NO_GLIBC)
def test_arrays_take_the_memory_of_those_before_them() -> None:
    page = 1 << 12
    assert _faults(keep=False) >= 5 * (1 << 26) // (1 << 21)  # huge pages at the most
    assert _faults(keep=True) * page < 1 << 22


def test_another_c_library_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ctypes, "CDLL", lambda name: object())
    assert not keep_freed_memory()
