"""The decoder of `lightpage.codec.ldpc.decoder` compiled by numba, to see what a compiler would gain."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.codec.ldpc.code import LdpcCode
from lightpage.codec.ldpc.decoder import MOST_ITERATIONS, MOST_LLR, OFFSET


def compiled() -> Any:
    """The compiled function: LLRs of the word, checks, their degrees, iterations, offset; to iterations, 0 on failure.

    Raises:
        ModuleNotFoundError: numba is not installed.
    """
    import numba

    @numba.njit(fastmath=True, nogil=True)
    def decode(word: Any, checks: Any, degrees: Any, iterations: int, offset: Any) -> int:  # pragma: no cover
        rows, most, size = checks.shape
        messages = np.zeros((rows, most, size), np.float32)
        others = np.empty(most, np.float32)
        for iteration in range(iterations):
            for row in range(rows):
                degree = degrees[row]
                for z in range(size):
                    least, second, odd = np.float32(1e9), np.float32(1e9), False
                    for i in range(degree):
                        value = word[checks[row, i, z]] - messages[row, i, z]
                        others[i] = value
                        odd ^= value < 0
                        value = abs(value)
                        second = min(second, max(least, value))
                        least = min(least, value)
                    for i in range(degree):
                        value = others[i]
                        told = max((second if abs(value) == least else least) - offset, np.float32(0))
                        told = -told if odd ^ (value < 0) else told
                        messages[row, i, z] = told
                        word[checks[row, i, z]] = value + told
            failed = False
            for row in range(rows):
                for z in range(size):
                    odd = False
                    for i in range(degrees[row]):
                        odd ^= word[checks[row, i, z]] < 0
                    failed |= odd
                if failed:
                    break
            if not failed:
                return iteration + 1
        return 0

    return decode


class NumbaDecoder:
    """One code, compiled."""

    def __init__(self, code: LdpcCode) -> None:
        self._code, self._decode = code, compiled()
        most = max(len(check) for check in code.checks)
        self._checks = np.zeros((len(code.checks), most, code.lifting), np.int32)
        for row, check in enumerate(code.checks):
            self._checks[row, : len(check)] = check
        self._degrees = np.array([len(check) for check in code.checks], np.int32)

    def decode(self, llrs: NDArray[np.float32]) -> tuple[NDArray[np.uint8], int]:
        """Information bits of a block and the iterations that it took, 0 where it failed."""
        word = np.zeros(self._code.word_bits, np.float32)
        word[self._code.fillers] = 1e4
        word[self._code.sent] = np.clip(llrs, -MOST_LLR, MOST_LLR)
        taken = self._decode(word, self._checks, self._degrees, MOST_ITERATIONS, OFFSET)
        return (word[: self._code.information_bits] < 0).astype(np.uint8), int(taken)
