"""The thread count follows the container, not the machine, and threads share the memory that each of them frees."""

from __future__ import annotations

import ctypes
import os
from pathlib import Path
from types import SimpleNamespace

import pytest

from runtime.execution.cpus import available_cpus
from runtime.execution.memory import share_freed_memory


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


def test_threads_take_memory_from_two_places_where_the_c_library_can_be_told(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[tuple[int, int]] = []
    libc = SimpleNamespace(mallopt=lambda *option: not told.append(option))
    monkeypatch.setattr(ctypes, "CDLL", lambda name: libc)
    assert share_freed_memory()
    assert told == [(-8, 2)]  # M_ARENA_MAX of glibc
    monkeypatch.setattr(ctypes, "CDLL", lambda name: object())
    assert not share_freed_memory()
