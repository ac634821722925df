"""LDPC code of 5G New Radio: which bits its parity checks join, and its encoder.

3GPP TS 38.212, section 5.3.2, base graph 1: 46 rows of checks, 68 columns of bits, each a group of Z. An entry (row,
column, shift s) says that bit (z + s) mod Z of the column's group takes part in check z of the row's group. `K`
information bits fill the first 22 groups, zeros that are not sent (fillers) the rest of them. The first two groups are
never sent. The first `n` of the others are, parity bits last; rows whose parity bit is not sent are left out.
"""

from __future__ import annotations

from functools import cached_property, lru_cache
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import InvalidInputError

Bits = NDArray[np.uint8]

_INFORMATION_GROUPS = 22
_CORE_ROWS = 4
"""Rows whose parity bits depend on each other; every later row has one parity bit of its own."""
_PUNCTURED_GROUPS = 2
_LIFTING_FAMILIES = (2, 3, 5, 7, 9, 11, 13, 15)
_LARGEST_LIFTING = 384
MOST_INFORMATION_BITS = _INFORMATION_GROUPS * _LARGEST_LIFTING


@lru_cache(1)
def _base_graph() -> NDArray[np.int64]:
    """Rows of (row, column, shift of each lifting family)."""
    with files("lightpage.codec.ldpc").joinpath("base_graph_1.csv").open() as file:
        return np.loadtxt(file, delimiter=",", skiprows=1, dtype=np.int64)


def _liftings() -> dict[int, int]:
    """Every lifting size Z with the family that its shifts come from, ascending."""
    sizes = {
        base << power: family
        for family, base in enumerate(_LIFTING_FAMILIES)
        for power in range(8)
        if base << power <= _LARGEST_LIFTING
    }
    return dict(sorted(sizes.items()))


class LdpcCode:
    """A code of `information_bits` bits in a block of `sent_bits`.

    Args:
        information_bits: K, 1 to 8448.
        sent_bits: n, more than K; at the lowest rate, 66 of 22 groups are sent.

    Raises:
        InvalidInputError: a block that this base graph does not make.
    """

    def __init__(self, information_bits: int, sent_bits: int) -> None:
        if not 1 <= information_bits <= MOST_INFORMATION_BITS:
            raise InvalidInputError("LDPC code: information bits", information_bits, f"1 to {MOST_INFORMATION_BITS}")
        self.information_bits, self.sent_bits = information_bits, sent_bits
        self.lifting, family = next(
            (z, family) for z, family in _liftings().items() if _INFORMATION_GROUPS * z >= information_bits
        )
        graph = _base_graph()
        fillers = _INFORMATION_GROUPS * self.lifting - information_bits
        groups = -(-(sent_bits + fillers) // self.lifting) + _PUNCTURED_GROUPS
        rows = max(_CORE_ROWS, groups - _INFORMATION_GROUPS)
        most = int(graph[:, 0].max()) + 1
        if sent_bits <= information_bits or rows > most:
            longest = (_INFORMATION_GROUPS + most - _PUNCTURED_GROUPS) * self.lifting - fillers
            raise InvalidInputError(
                f"LDPC code of {information_bits} bits: sent bits",
                sent_bits,
                f"{information_bits + 1} to {longest}",
            )
        self.groups = _INFORMATION_GROUPS + rows
        taken = graph[graph[:, 0] < rows]
        self._shift = {(int(r), int(c)): int(s) % self.lifting for r, c, s in taken[:, [0, 1, 2 + family]]}
        self._rows = rows

    @property
    def rate(self) -> float:
        """Information bits over sent bits."""
        return self.information_bits / self.sent_bits

    @cached_property
    def sent(self) -> NDArray[np.intp]:
        """Indices of the sent bits in the whole word, [n]."""
        index = np.arange(_PUNCTURED_GROUPS * self.lifting, self.groups * self.lifting)
        filler = (index >= self.information_bits) & (index < _INFORMATION_GROUPS * self.lifting)
        return index[~filler][: self.sent_bits]

    @cached_property
    def fillers(self) -> slice:
        """Range of the word's fillers: zeros that both sides know."""
        return slice(self.information_bits, _INFORMATION_GROUPS * self.lifting)

    @cached_property
    def checks(self) -> tuple[NDArray[np.intp], ...]:
        """Bits of each row's Z checks: indices into the whole word, a row's array being [bits of a check, Z]."""
        z = np.arange(self.lifting)
        return tuple(
            np.stack([c * self.lifting + (z + s) % self.lifting for (r, c), s in self._shift.items() if r == row])
            for row in range(self._rows)
        )

    @cached_property
    def rows(self) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Number of bits in the checks of each row, [rows]; column group and shift of each of these bits, [bits, 2]."""
        entries = [(c, s) for row in range(self._rows) for (r, c), s in self._shift.items() if r == row]
        degrees = np.bincount([r for r, _ in self._shift], minlength=self._rows)
        return degrees.astype(np.int32), np.array(entries, np.int32)

    @property
    def word_bits(self) -> int:
        """Bits of the whole word, those included that are not sent."""
        return self.groups * self.lifting

    def encode(self, information: Bits) -> Bits:
        """Encode blocks of bits.

        Args:
            information: 0 and 1, uint8 [blocks, K].

        Returns:
            The sent bits, uint8 [blocks, n].

        Raises:
            InvalidInputError: blocks of another length.
        """
        if information.ndim != 2 or information.shape[1] != self.information_bits:
            raise InvalidInputError(
                "LDPC code: information", f"shape {information.shape}", f"(blocks, {self.information_bits})"
            )
        blocks, size = len(information), self.lifting
        word = np.zeros((self.groups, blocks, size), np.uint8)
        padded = np.zeros((blocks, _INFORMATION_GROUPS * size), np.uint8)
        padded[:, : self.information_bits] = information
        word[:_INFORMATION_GROUPS] = padded.reshape(blocks, _INFORMATION_GROUPS, size).swapaxes(0, 1)
        self._add_core_parity(word)
        for row in range(_CORE_ROWS, self._rows):
            word[_INFORMATION_GROUPS + row] = self._sum(word, row)
        return np.ascontiguousarray(word.swapaxes(0, 1).reshape(blocks, -1)[:, self.sent])

    def _sum(self, word: Bits, row: int) -> Bits:
        """Parity of what a row joins among the bits that are known, [blocks, Z]; unknown groups are still zero."""
        parts = [np.roll(word[c], -s, axis=-1) for (r, c), s in self._shift.items() if r == row and word[c].any()]
        return np.bitwise_xor.reduce(parts, axis=0) if parts else np.zeros_like(word[0])

    def _add_core_parity(self, word: Bits) -> None:
        """The first four parity groups. In the sum of their rows all but the first cancel, that one but for a shift."""
        first = _INFORMATION_GROUPS
        sums = [self._sum(word, row) for row in range(_CORE_ROWS)]
        shifts = [self._shift[row, first] for row in range(_CORE_ROWS) if (row, first) in self._shift]
        shift = next(s for s in shifts if shifts.count(s) % 2)
        word[first] = np.roll(np.bitwise_xor.reduce(sums, axis=0), shift, axis=-1)
        unknown = set(range(first + 1, first + _CORE_ROWS))
        while unknown:
            for row in range(_CORE_ROWS):
                missing = [group for group in unknown if (row, group) in self._shift]
                if len(missing) == 1:
                    word[missing[0]] = np.roll(self._sum(word, row), self._shift[row, missing[0]], axis=-1)
                    unknown.remove(missing[0])
