"""Pages of a simulated device whose symbols are known."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.calibrate import KnownPage, calibrate
from lightpage.calibration.document import Calibration
from lightpage.device.profile import Profile
from lightpage.device.state import Device
from lightpage.page.levels import MAX_LEVELS
from lightpage.page.symbols import random_symbols, symbol_phases
from lightpage.progress import Progress
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import hash_frames
from lightpage.simulator.simulator import Simulator
from lightpage.train.models.field import FieldRecovery, TorchFieldSolver
from lightpage.train.models.twin import RayTwin, TorchTwin

FITTED_PAGES = 2
"""Known pages of a calibration, as `lightpage calibrate` takes them."""
_FIRST_SEED = 10_000
"""First seed of the pages that decoders are judged by, far from those that they are trained on."""
_SYMBOLS = 3
"""Random stream of their symbols, beside those of the simulator."""


@dataclass(frozen=True)
class Known:
    """Pages of a simulated device whose symbols are known.

    Attributes:
        references: reference-only frames.
        pairs: frame pairs, one a page.
        symbols: symbols that were written, uint8 [ny, nx], one a page.
    """

    references: FramePair
    pairs: tuple[FramePair, ...]
    symbols: tuple[NDArray[np.uint8], ...]

    @classmethod
    def of(cls, profile: Profile, device: Device, pages: int, seed: int) -> Self:
        """Simulate pages; those of one seed carry the same symbols and noise whatever the device."""
        simulator = Simulator(profile, device, MAX_LEVELS, _FIRST_SEED + seed)
        rng = np.random.default_rng([_FIRST_SEED + seed, _SYMBOLS])
        symbols = random_symbols(profile, MAX_LEVELS, pages, rng)
        return cls(simulator.references(), tuple(simulator.page(page) for page in symbols), tuple(symbols))

    def part(self, pages: slice) -> Self:
        """Return some of the pages."""
        return replace(self, pairs=self.pairs[pages], symbols=self.symbols[pages])

    def calibration(self, profile: Profile, progress: Progress) -> Calibration:
        """Calibrate from nominal with these pages.

        Raises:
            CalibrationError: nothing within the capture range explains them.
        """
        pages = [
            KnownPage(pair, np.exp(1j * symbol_phases(symbols, MAX_LEVELS)))
            for pair, symbols in zip(self.pairs, self.symbols, strict=True)
        ]
        twin, solver = TorchTwin(RayTwin(profile)), TorchFieldSolver(FieldRecovery(profile))
        registered = calibrate(twin, solver, profile, self.references, pages, progress)
        return Calibration.from_registered(registered, profile, [hash_frames(pair) for pair in self.pairs])
