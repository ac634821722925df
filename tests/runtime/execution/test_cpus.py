"""The thread count follows the container, not the machine, and threads share the memory that each of them frees."""

from __future__ import annotations

import ctypes
import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

from runtime.execution.cpus import available_cpus
from runtime.execution.memory import share_freed_memory
from tests.skips import NO_GLIBC


@pytest.mark.parametrize(
    ("files", "membership", "cores"),
    [
        ({"cpu.max": "150000 100000\n"}, "0::/\n", 2),
        ({"cpu.max": "max 100000\n"}, "0::/\n", 64),
        ({"a/cpu.max": "400000 100000", "a/b/cpu.max": "800000 100000"}, "0::/a/b\n", 4),
        (
            {"cpu,cpuacct/j/cpu.cfs_quota_us": "50000", "cpu,cpuacct/j/cpu.cfs_period_us": "100000"},
            "4:cpu,cpuacct:/j",
            1,
        ),
        ({"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"}, "1:cpu:/\n", 64),
        ({}, "", 64),
    ],
)
def test_quota_of_the_control_group_holds(
    files: dict[str, str], membership: str, cores: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(64)))
    (root := tmp_path / "cgroup").mkdir()
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    (tmp_path / "self").write_text(membership)
    assert available_cpus(root, tmp_path / "self") == cores


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


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason=NO_GLIBC)
def test_many_threads_take_memory_from_two_places() -> None:
    for shared in (False, True):
        command = [sys.executable, "-c", _PROGRAM.format(shared=shared)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
        assert (done.stderr.count("<heap nr=") <= 2) == shared


def test_another_c_library_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ctypes, "CDLL", lambda name: object())
    assert not share_freed_memory()
