"""Decoders of LDPC blocks side by side, on the same blocks in turns."""

from __future__ import annotations

import time
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.codec.computed_by import computed_by
from lightpage.codec.compiled.choice import COMPILED, NUMPY
from lightpage.codec.ldpc.code import LdpcCode
from lightpage.codec.ldpc.decoder import MOST_ITERATIONS, decode
from lightpage.codec.mapping import bit_information

Blocks = NDArray[np.float32]
CODES = {"0.66": (6270, 9500), "0.50": (4750, 9500)}
"""Information and sent bits: about a bench page in bright and in dim light."""
_GAP = 0.075
"""Information beyond the rate at which blocks are drawn: a page with some margin."""


def drawn(code: LdpcCode, count: int, rng: np.random.Generator) -> tuple[NDArray[np.uint8], Blocks]:
    """Blocks and their LLRs in Gaussian noise, at a gap of `_GAP` above the code's rate."""
    bits = rng.integers(0, 2, (count, code.information_bits), dtype=np.uint8)
    sent = code.encode(bits)
    low, high = 0.1, 3.0
    noise = rng.standard_normal(sent.shape)

    def seen(sigma: float) -> NDArray[np.float64]:
        return np.asarray(2 * (1 - 2.0 * sent + sigma * noise) / sigma**2)

    for _ in range(20):
        sigma = (low + high) / 2
        low, high = (sigma, high) if bit_information(seen(sigma), sent) > code.rate + _GAP else (low, sigma)
    return bits, seen((low + high) / 2).astype(np.float32)


def by_library(code: LdpcCode) -> Callable[[Blocks], NDArray[np.uint8]]:
    """Minimum-sum of the package `ldpc`."""
    from ldpc.bp_decoder import BpDecoder
    from scipy.sparse import csr_matrix

    checks = [np.arange(code.lifting) + row * code.lifting for row in range(len(code.checks))]
    rows = np.concatenate([np.tile(own, len(bits)) for own, bits in zip(checks, code.checks, strict=True)])
    columns = np.concatenate([check.ravel() for check in code.checks])
    matrix = csr_matrix((np.ones(len(rows), np.uint8), (rows, columns)))
    coder = BpDecoder(
        matrix, error_rate=0.1, max_iter=MOST_ITERATIONS, bp_method="minimum_sum", ms_scaling_factor=0.75,
        schedule="serial",
    )  # fmt: skip

    def one(llrs: Blocks) -> NDArray[np.uint8]:
        word = np.zeros(code.word_bits)
        word[code.fillers] = 40
        word[code.sent] = np.clip(llrs, -40, 40)
        coder.update_channel_probs(1 / (1 + np.exp(np.abs(word))))
        flips = coder.decode(np.asarray(matrix @ (word < 0) % 2, np.uint8))
        return np.asarray(((word < 0) ^ flips.astype(bool))[: code.information_bits], np.uint8)

    return lambda blocks: np.stack([one(block) for block in blocks])


def decoders(code: LdpcCode) -> dict[str, Callable[[Blocks], NDArray[np.uint8]]]:
    """Decoders of blocks by name."""

    def by(name: str) -> Callable[[Blocks], NDArray[np.uint8]]:
        def all_of(blocks: Blocks) -> NDArray[np.uint8]:
            with computed_by(name):
                return decode(code, blocks).information

        return all_of

    return {
        "numpy, one block": lambda blocks: np.concatenate([by(NUMPY)(block[None]) for block in blocks]),
        "numpy, 16 blocks": by(NUMPY),
        "compiled": by(COMPILED),
        "ldpc (C++)": by_library(code),
    }


BROUGHT = {"ldpc": ("ldpc", "stim", "sinter", "pymatching", "networkx")}
"""Distributions that a decoder would bring into the image."""


def megabytes(names: tuple[str, ...]) -> float:
    """Installed size of distributions."""
    total = 0
    for name in names:
        try:
            files = distribution(name).files or []
        except PackageNotFoundError:
            continue
        total += sum(path.stat().st_size for file in files if (path := Path(str(file.locate()))).is_file())
    return total / 1e6


def time_decoders(count: int, rounds: int) -> list[dict[str, Any]]:
    """Milliseconds a block of each decoder, the best of some rounds, and whether all came out right."""
    found = []
    for name, (information, sent) in CODES.items():
        code = LdpcCode(information, sent)
        bits, llrs = drawn(code, count, np.random.default_rng(0))
        ways = decoders(code)
        best = dict.fromkeys(ways, float("inf"))
        right = {}
        for way in ways.values():
            way(llrs[:2])  # into the cache
        for _ in range(rounds):
            for way_name, way in ways.items():
                start = time.process_time()
                decoded = way(llrs)
                best[way_name] = min(best[way_name], (time.process_time() - start) / count)
                right[way_name] = int(np.count_nonzero((decoded == bits).all(axis=1)))
        for way_name, seconds in best.items():
            size = megabytes(BROUGHT.get(way_name.partition(" ")[0], ()))
            found.append(
                {
                    "rate": name,
                    "decoder": way_name,
                    "ms": 1e3 * seconds,
                    "megabits_per_second": information / seconds / 1e6,
                    "right": right[way_name],
                    "blocks": count,
                    "brought_MB": size,
                }
            )
    return found
