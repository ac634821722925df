"""Layered offset min-sum decoding of LDPC blocks: in numpy, many at once, and by the compiled arithmetic bit for bit.

Each row of the base graph is a layer of Z independent checks. A check tells every bit of it the least certain of the
other bits, with the sign that makes the parity even, less an offset (Chen et al., IEEE Trans. Commun. 53, 1288, 2005).
The next layer already uses what this one found.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from lightpage.codec.compiled.choice import compiled, spread
from lightpage.codec.ldpc.code import Bits, LdpcCode
from lightpage.errors import InvalidInputError

OFFSET = np.float32(0.5)
"""Takes off what min-sum is too sure of; a factor of 0.75 instead fails at low rates."""
MOST_LLR = 40.0
"""Log-likelihood ratios are clipped here: a bit that is certain and wrong must not outvote all checks."""
_KNOWN = np.float32(1e4)
"""LLR of a filler, which both sides know to be 0."""
_SIGN = np.uint32(0x80000000)
_BLOCKS_AT_ONCE = 16
"""More leave the cache and are slower a block."""
MOST_ITERATIONS = 25


@dataclass(frozen=True)
class DecodedBlocks:
    """Decoded LDPC blocks.

    Attributes:
        information: uint8 [blocks, K].
        sent: the code word's sent bits, uint8 [blocks, n]; of a block that failed, the decoder's last guess.
        converged: whether all checks hold, bool [blocks].
        iterations: number of iterations, int [blocks].
    """

    information: Bits
    sent: Bits
    converged: NDArray[np.bool_]
    iterations: NDArray[np.int64]


def decode(
    code: LdpcCode, llrs: NDArray[np.floating], iterations: int = MOST_ITERATIONS, threads: int = 1
) -> DecodedBlocks:
    """Decode blocks; each stops as soon as all of its checks hold.

    Args:
        code: code that the blocks were encoded with.
        llrs: log-likelihood ratios ln P(0) / P(1) of the sent bits, [blocks, n].
        iterations: largest number of iterations.
        threads: number of threads that share the blocks where the decoder is compiled.

    Raises:
        InvalidInputError: another shape, or a value that is no number.
    """
    if llrs.ndim != 2 or llrs.shape[1] != code.sent_bits:
        raise InvalidInputError("LDPC decoder: LLRs", f"shape {llrs.shape}", f"(blocks, {code.sent_bits})")
    if np.isnan(llrs).any():
        raise InvalidInputError("LDPC decoder: LLRs", "NaN", "numbers")
    native = compiled()
    if native is not None and iterations > 0:
        return _decode_compiled(native, code, llrs, iterations, threads)
    blocks = len(llrs)
    words = np.zeros((code.word_bits, blocks), np.bool_)
    converged, taken = np.zeros(blocks, np.bool_), np.full(blocks, iterations)
    for start in range(0, blocks, _BLOCKS_AT_ONCE):
        some = slice(start, start + _BLOCKS_AT_ONCE)
        _decode_some(code, llrs[some], iterations, words[:, some], converged[some], taken[some])
    bits = words.T.astype(np.uint8)
    return DecodedBlocks(bits[:, : code.information_bits], bits[:, code.sent], converged, taken)


def _decode_compiled(
    native: ModuleType, code: LdpcCode, llrs: NDArray[np.floating], iterations: int, threads: int
) -> DecodedBlocks:
    with np.errstate(over="ignore"):  # infinity is clipped like all else
        ratios = np.ascontiguousarray(llrs, np.float32)
    blocks, graph = len(ratios), (*code.rows, code.lifting, code.information_bits, code.sent_bits)
    information = np.empty((blocks, code.information_bits), np.uint8)
    sent, taken = np.empty(ratios.shape, np.uint8), np.empty(blocks, np.int32)

    def work(some: slice) -> None:
        native.decode_blocks(
            graph, iterations, OFFSET, MOST_LLR, _KNOWN, ratios[some], information[some], sent[some], taken[some]
        )

    spread(work, blocks, threads)
    return DecodedBlocks(information, sent, taken > 0, np.where(taken > 0, taken, iterations).astype(np.int64))


def _decode_some(
    code: LdpcCode,
    llrs: NDArray[np.floating],
    iterations: int,
    words: NDArray[np.bool_],
    converged: NDArray[np.bool_],
    taken: NDArray[np.int64],
) -> None:
    """Decode a few blocks into the three arrays; blocks that have converged leave the batch."""
    left = np.arange(len(llrs))
    belief = np.zeros((code.word_bits, len(llrs)), np.float32)
    belief[code.fillers] = _KNOWN
    belief[code.sent] = np.clip(llrs.T, -MOST_LLR, MOST_LLR)
    told = [np.zeros((*check.shape, len(llrs)), np.float32) for check in code.checks]
    for iteration in range(1, iterations + 1):
        for check, messages in zip(code.checks, told, strict=True):
            _update_layer(belief, check, messages)
        decided = belief < 0
        words[:, left] = decided
        odd = [np.bitwise_xor.reduce(decided[check], axis=0).any(axis=0) for check in code.checks]
        done = ~np.any(odd, axis=0)
        if done.any():
            converged[left[done]], taken[left[done]] = True, iteration
            left, belief = left[~done], np.ascontiguousarray(belief[:, ~done])
            told = [np.ascontiguousarray(messages[..., ~done]) for messages in told]
        if not left.size:
            break


def _update_layer(belief: NDArray[np.float32], check: NDArray[np.intp], messages: NDArray[np.float32]) -> None:
    """Renew what the Z checks of a layer tell their bits, in place.

    Args:
        belief: log-likelihood ratio of every bit, [word, blocks].
        check: bits of each check, [degree, Z].
        messages: messages of each check to each of its bits in the iteration before, [degree, Z, blocks].
    """
    others = np.take(belief, check, axis=0, mode="clip")
    others -= messages
    size = np.abs(others)
    least, second = np.minimum(size[0], size[1]), np.maximum(size[0], size[1])
    for one in size[2:]:
        np.minimum(second, np.maximum(least, one), out=second)
        np.minimum(least, one, out=least)
    signs = others.view(np.uint32) & _SIGN
    signs ^= np.bitwise_xor.reduce(signs, axis=0)
    is_least = size == least
    for magnitude in (least, second):
        magnitude -= OFFSET
        np.maximum(magnitude, 0, out=magnitude)
    messages[...] = np.where(is_least, second, least)
    messages.view(np.uint32)[...] |= signs
    others += messages
    belief[check] = others
