"""Calculations on several threads: as many as the environment says, in order, and none once nobody wants them."""

import threading
import time

import pytest

from lightpage.systems import cores
from lightpage.waves.parallel import in_parallel, threads_beside


def test_results_come_in_order_and_a_fault_ends_the_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "1")
    for chosen, expected in (("3", 3), ("0", 1), ("", cores())):
        monkeypatch.setenv("OMP_NUM_THREADS", chosen)
        assert threads_beside() == expected
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    together, begun = threading.Barrier(3, timeout=30), list[int]()

    def root(item: int) -> float:
        begun.append(item)
        if item < 3:
            together.wait()  # three compute at a time
            time.sleep(0.01 * (3 - item))
        return float(item) ** (0.5 if item < 50 else 1 / (item - 50))

    assert list(in_parallel(root, range(9))) == [item**0.5 for item in range(9)]
    begun.clear()
    with pytest.raises(ZeroDivisionError):
        list(in_parallel(root, range(40, 1000)))
    assert max(begun) < 60
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")
    assert threads_beside() == 1
