"""Weights of kept decoders: large tensors in whole steps, as coarse as what the decoder says allows, then compressed.

Half precision rounds all tensors alike. What a decoder says depends on some of them a thousand times more than on
others, so each gets a step of its own. They are found on a few pages.
"""

from __future__ import annotations

import io
import lzma
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import i0e
from torch import Tensor
from torch.utils.data import Dataset

from lightpage.errors import InvalidInputError
from lightpage.files import replace_file
from lightpage.train.data.pages import Page
from lightpage.train.fitting.concentration_scale import decode_pages
from lightpage.train.fitting.modules import DecoderTraining
from lightpage.von_mises import mean_resultant

MOST_MOVED_BITS = 1e-4
"""Largest change by rounding of what a decoder says, as a mean over symbols: below the fourth digit of every AIR."""
LARGE = 1000
"""Numbers of a tensor from which it is rounded; the others are kept as they are."""
_PROBE = 1 / 16
"""Step by which the effect of a tensor's rounding is found, and of the coarsest one, over its root mean square."""
_LEAST_MOVED_BITS = 1e-9
_MOST_STEPS = 127 * 256 + 127
"""Largest whole number that two signed bytes hold, the low one of which may be negative."""
_TRIES = 60
_STEP, _HIGH = ":step", ":high"
"""Behind a tensor's name: its step; and of its whole numbers what one byte cannot hold."""
_PACKED = [{"id": lzma.FILTER_LZMA2, "preset": 9 | lzma.PRESET_EXTREME, "lc": 0, "lp": 0, "pb": 0}]
"""No byte says anything of the next."""


def steps(module: DecoderTraining[Any], pages: Dataset[Page]) -> dict[str, float]:
    """The step of each large tensor, by name, at which what the module says of pages changes by `MOST_MOVED_BITS`.

    A change grows as the square of a step, and the changes by all tensors add up. They are shared out by the numbers
    that each tensor has, which makes the fewest bytes.

    Raises:
        InvalidInputError: there are no such steps.
    """
    whole = {name: value.clone() for name, value in module.network.state_dict().items()}
    large = {
        name: value
        for name, value in whole.items()
        if value.is_floating_point() and value.numel() >= LARGE and value.any()
    }
    before = decode_pages(module, pages)[0]

    def moved(by: Mapping[str, float]) -> float:
        module.network.load_state_dict(whole | {name: torch.round(large[name] / by[name]) * by[name] for name in by})
        return moved_bits(before, decode_pages(module, pages)[0])

    probes = {name: float(value.square().mean().sqrt()) * _PROBE for name, value in large.items()}
    shares = {name: large[name].numel() / sum(map(torch.numel, large.values())) for name in large}
    effects = {name: max(moved({name: step}), _LEAST_MOVED_BITS) for name, step in probes.items()}
    allowed, found = MOST_MOVED_BITS, dict[str, float]()
    try:
        for _ in range(_TRIES):
            for name, step in probes.items():
                finest, coarsest = float(large[name].abs().max()) / _MOST_STEPS, step / _PROBE
                found[name] = min(max(step * math.sqrt(allowed * shares[name] / effects[name]), finest), coarsest)
            if moved(found) <= MOST_MOVED_BITS:
                return found
            allowed *= 0.7
    finally:
        module.network.load_state_dict(whole)
    raise InvalidInputError("weights", "numbers that even two bytes each change too much", "a decoder that was trained")


def moved_bits(before: NDArray[np.floating], after: NDArray[np.floating]) -> float:
    """Relative entropy of what was said of symbols to what is said now, bits, mean; p is [pages, 2, ny, nx]."""
    p, q = np.asarray(before, np.float64), np.asarray(after, np.float64)
    kappa, now = np.hypot(p[:, 0], p[:, 1]), np.hypot(q[:, 0], q[:, 1])
    along = (p * q).sum(1) / np.maximum(kappa, np.finfo(float).tiny)
    nats = np.log(i0e(now) / i0e(kappa)) + now - kappa + mean_resultant(kappa) * (kappa - along)
    return float(nats.mean()) / math.log(2)


def write_weights(path: Path, weights: Mapping[str, Tensor], by: Mapping[str, float]) -> None:
    """Write weights, those that have a step in whole numbers of it; a number is two bytes at most.

    Raises:
        InvalidInputError: the path cannot be written.
    """
    arrays = dict[str, NDArray[Any]]()
    for name, value in weights.items():
        if name not in by:
            arrays[name] = value.numpy()
            continue
        whole = torch.round(value / by[name]).numpy().astype(np.int16)
        arrays[name], arrays[name + _STEP] = whole.astype(np.int8), np.array(by[name], np.float32)
        arrays[name + _HIGH] = ((whole.astype(np.int32) - arrays[name]) >> 8).astype(np.int8)
    content = io.BytesIO()
    np.savez(content, **arrays)  # type: ignore[arg-type]  # no name is `allow_pickle`
    packed = lzma.compress(content.getvalue(), filters=_PACKED)
    replace_file(path, lambda file: file.write(packed), "weights")


def read_weights(path: Path) -> dict[str, Tensor]:
    """Read weights that `write_weights` wrote: float32 where they were rounded, else of the type that they had.

    Raises:
        InvalidInputError: they are missing or damaged.
    """
    try:
        with np.load(io.BytesIO(lzma.decompress(path.read_bytes()))) as kept:
            arrays = dict(kept)
        for name in [name for name in arrays if name + _STEP in arrays]:
            whole = arrays[name] + 256 * arrays.pop(name + _HIGH).astype(np.float32)
            arrays[name] = whole * arrays.pop(name + _STEP)
    except (OSError, lzma.LZMAError, EOFError, ValueError, KeyError, BadZipFile) as error:
        raise InvalidInputError(f"kept weights {path}", error, "those that --keep has written") from None
    return {name: torch.from_numpy(value) for name, value in arrays.items()}
