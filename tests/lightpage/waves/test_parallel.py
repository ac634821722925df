"""Calculations on several threads: as many as the environment says, in order, and none once one has failed."""

import threading

import pytest

from lightpage.systems import cores
from lightpage.waves.parallel import in_parallel, threads_beside


def test_results_come_in_order_and_a_fault_ends_the_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    for products, chosen, expected in (("2", "3", 1), ("1", "0", 1), ("1", "", cores()), ("1", " 3,1", 3)):
        monkeypatch.setenv("OPENBLAS_NUM_THREADS", products)
        monkeypatch.setenv("OMP_NUM_THREADS", chosen)
        assert threads_beside() == expected
    together, begun = threading.Barrier(3, timeout=30), list[int]()

    def inverse(item: int) -> float:
        begun.append(item)
        if item <= 3:
            together.wait()  # three compute at a time
        threading.Event().wait(0.02 * (item > 50))
        return 1 / (item - 50)

    assert list(in_parallel(inverse, range(1, 9))) == [1 / (item - 50) for item in range(1, 9)]
    with pytest.raises(ZeroDivisionError):
        list(in_parallel(inverse, range(40, 1000)))
    assert max(begun) < 500
    nested = in_parallel(lambda _: {threading.get_ident(), *in_parallel(lambda _: threading.get_ident(), "abc")}, "ab")
    assert [len(threads) for threads in nested] == [1, 1]  # one of several keeps to its thread
