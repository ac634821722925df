"""Known pages of a toy device that has drifted, and workers that fit it, or come to no good end."""

import os
import signal
from typing import Any

import numpy as np

from lightpage.errors import RecalibrationRefusedError
from lightpage.helper_process import Helper
from lightpage.progress import Progress
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.recalibration.known_pages import KnownPages
from lightpage.runtime.recalibration.recalibration import RefitResult
from lightpage.runtime.recalibration.worker import RecalibrationWorker, yield_to_reads
from tests.runtime import toy

DRIFTED = (150.0, 62.0)


def known(offsets: tuple[float, float] = DRIFTED, count: int = 3, levels: int = 16) -> KnownPages:
    device = toy.ToyDevice(offsets)
    symbols = toy.symbols_of(levels, 11, count)
    pairs = tuple(device.page(page, levels, 0.3) for page in symbols)
    return KnownPages(pairs, tuple(symbols), levels, device.references())


def shuffled(pages: KnownPages, which: slice) -> KnownPages:
    """The pages, some of them with symbols that are not theirs."""
    symbols = list(pages.symbols)
    rng = np.random.default_rng(2)
    for index in range(*which.indices(len(symbols))):
        symbols[index] = rng.integers(16, size=toy.PAGE).astype(np.uint8)
    return KnownPages(pages.pairs, tuple(symbols), pages.levels, pages.references)


def quiet(step: str, share: float) -> None:
    """No progress."""


def fit(bundle: Bundle, pages: KnownPages, progress: Progress, decoder: Decoder) -> RefitResult:
    progress(f"fit in {os.getpid()} at {os.nice(0)}", 0.5)
    return toy.fit_references(bundle, pages, progress, decoder)


class Sound(RecalibrationWorker):
    fit = staticmethod(fit)

    def __init__(self) -> None:
        yield_to_reads()


class Unyielding(RecalibrationWorker):
    def __init__(self) -> None:
        """Take one's share of the processor: other tests leave little else."""


class Refusing(Helper):
    def recalibrate(self, *task: Any, progress: Progress) -> None:
        raise RecalibrationRefusedError("fit", "worse", "better")


class Limited(Helper):
    """Says how many steps of a page it may take."""

    def recalibrate(self, *task: Any, progress: Progress) -> None:
        raise RecalibrationRefusedError("steps", task[-1], "none")


class Broken(Helper):
    def recalibrate(self, *task: Any, progress: Progress) -> None:
        raise ZeroDivisionError


class Silent(Helper):
    def recalibrate(self, *task: Any, progress: Progress) -> None:
        progress(f"fit in {os.getpid()}", 0.5)
        signal.pause()
