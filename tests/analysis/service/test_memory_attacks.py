"""The judge of attacks on shared memory overlooks nothing that it measures."""

from __future__ import annotations

from typing import Any

import pytest

from analysis.service.memory_attacks import faults

GOOD: dict[str, Any] = {
    "crashes": 0,
    "reads_outside": 0,
    "tracebacks": 0,
    "failed": [],
    "good_at_the_end": True,
    "regions_and_files_before": (1, 40),
    "regions_and_files_after": (0, 38),
    "receive_buffer_bytes_after": 0,
}


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("crashes", 1, "1 crashes"),
        ("reads_outside", 2, "2 reads outside a region"),
        ("tracebacks", 3, "3 tracebacks"),
        ("failed", ["made-up handle: timed out"], "1 tries failed otherwise"),
        ("good_at_the_end", False, "no answer to a good pair at the end"),
        ("regions_and_files_after", (2, 38), "2 regions mapped at the end, 1 before"),
        ("regions_and_files_after", (0, 41), "41 files open at the end, 40 before"),
        ("receive_buffer_bytes_after", 4096, "4096 bytes of the receive budget never given back"),
    ],
)
def test_each_fault_is_told(name: str, value: object, said: str) -> None:
    assert faults(GOOD) == []
    assert faults(GOOD | {name: value}) == [said]
