"""What `page_code.c` offers. Arrays are contiguous and of the types in the comments; results go to the last ones."""

from typing import Any

from numpy.typing import NDArray

Array = NDArray[Any]
Neighbours = tuple[int, Array, Array, Array]
"""Width; cosines less 1 and sines, float64 [rows, width]; cosets, uint8 [levels, width], or none of even levels."""
Levels = tuple[
    int,  # levels
    int,  # label bits
    bool,  # whether levels are even
    int,  # level at the first place where levels follow each other, else -1
    Array,  # coefficients of sine and cosine, float64 [terms]
    Array,
    tuple[Array, float, Array, Array, int],  # circle, first border, borders, float64, starts, int64; most in a step
    Array,  # least concentration at which near neighbours suffice, float64 [rows]
    Neighbours,
    Neighbours,
]
Graph = tuple[Array, Array, int, int, int]
"""Bits of each row and their (column, shift), int32; lifting size, information bits, sent bits."""

def decode_blocks(
    code: Graph,
    iterations: int,
    offset: float,
    most: float,
    known: float,
    llrs: Array,  # float32 [blocks, sent]
    information: Array,  # uint8 [blocks, information]
    sent: Array,  # uint8 [blocks, sent]
    taken: Array,  # int32 [blocks], 0 where a block failed
    /,
) -> None: ...
def llrs(
    phase: Array,  # float64 [symbols], at most 1e6
    concentration: Array,  # float64 [symbols]
    levels: Levels,
    most: float,
    out: Array,  # float32 [symbols, label bits]
    /,
) -> None: ...
def lack_of_information(llrs: Array, bits: Array | None, /) -> int: ...
def upper_bits(
    phase: Array,  # float64 [symbols]
    label: Array,  # uint8 [symbols, label bits]
    label_bits: int,
    level_bits: int,
    searches: tuple[Array, Array, Array, int, Array] | None,  # of uneven levels, of each coset
    out: Array,  # uint8 [symbols, level bits - label bits]
    /,
) -> bool: ...  # whether no phase is larger than 1e6; else there is nothing
def look(phase: Array, concentration: Array, most: float, /) -> int: ...  # float64; 0: fine, 1: large, 2: no posterior
def gather(values: Array, order: Array, out: Array, /) -> None: ...  # float32 by int32
def scatter(bits: Array, order: Array, out: Array, /) -> None: ...  # uint8 by int32
def variants() -> tuple[str, ...]: ...
def use(number: int, /) -> None: ...
