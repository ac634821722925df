"""Outcome of a method: its figures, and its line of the table."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.comparison.levels import LevelFigures
from lightpage.calibration.document import Calibration
from lightpage.device.profile import Profile
from lightpage.report.traced import exit_centroids
from lightpage.train.fitting.curves import Curve

WALLS = {"no wall": (0, 0), "x": (1, 0), "y": (0, 1), "both": (1, 1)}
"""Columns of the table: whether a symbol's light meets walls of pair x, and of pair y."""

LAST_SHARE = 0.2
SETTLED_BITS = 0.02
"""A decoder whose validation AIR gains as much in that last share of its steps has not learnt what it could."""


def symbols_by_walls(profile: Profile, fitted: Calibration) -> dict[str, NDArray[np.bool_]]:
    """Return masks of the symbols whose light meets the walls of `WALLS`, bool [ny, nx] each."""
    met = np.rint(exit_centroids(profile, fitted)).astype(bool)
    return {name: (met[0] == x) & (met[1] == y) for name, (x, y) in WALLS.items()}


def gained_at_the_end(curve: Curve, steps: int) -> float:
    """Return the best value of a run's last fifth of steps less the best before it; NaN where either has none."""
    late = [value for step, value in curve if step > (1 - LAST_SHARE) * steps]
    early = [value for step, value in curve if step <= (1 - LAST_SHARE) * steps]
    return max(late) - max(early) if late and early else float("nan")


@dataclass(frozen=True)
class Outcome:
    """Outcome of one method with a network of one size.

    Rates are in bits per data symbol, errors are a share. `size` is that of `--size`, for the first pass's network.
    Steps, times and curves are those of the last pass, which continues from those before. Curves are AIR by step.

    Attributes:
        run: the method's folder.
        own_mi_unscaled: information that the decoder claims without `kappa_scale`.
        by_walls: AIR of the symbols whose light meets the walls of `WALLS`.
        pages_per_second: rate of training.
        kappa_scale: factor on the concentrations, fitted to the validation pages.
        passes: number of passes.
        over_oracle, over_published: ratios that `analysis.comparison.decoders.compared` sets.
        by_levels: figures among fewer levels.
    """

    run: str
    method: str
    size: str
    steps: int
    air: float
    symbol_error_rate: float
    own_mi: float
    own_mi_unscaled: float
    page_kB: float
    own_mi_kB: float
    by_walls: dict[str, float]
    validation_air: float
    gained_in_last_fifth: float
    preparing_seconds: float
    training_seconds: float
    pages_per_second: float
    kappa_scale: float
    training_curve: Curve
    validation_curve: Curve
    passes: int = 1
    over_oracle: float | None = None
    over_published: float | None = None
    by_levels: list[LevelFigures] = field(default_factory=list)

    @property
    def is_settled(self) -> bool:
        """Return whether more steps would hardly have helped; False if that is not known."""
        return self.gained_in_last_fifth < SETTLED_BITS

    def as_json(self) -> dict[str, Any]:
        """Return its entry in `figures.json` and `ablation.json`."""
        return asdict(self)

    def line(self) -> str:
        over = ["" if ratio is None else f"{ratio:.3f}" for ratio in (self.over_oracle, self.over_published)]
        walls = "".join(f"{self.by_walls[name]:>7.3f} " for name in WALLS)
        return (
            f"{self.method:<16} {self.size:<9} {self.steps:>6} {self.air:>8.3f} {self.own_mi:>7.3f} "
            f"{self.own_mi - self.air:>10.3f} {self.page_kB:>6.2f} {self.own_mi_kB:>6.2f} "
            f"{walls}{over[0]:>10} {over[1]:>10} "
            f"{self.gained_in_last_fifth:>8.3f}{' ' if self.is_settled else UNSETTLED} "
            f"{self.preparing_seconds / 60:>9.1f} {self.training_seconds / 60:>8.1f} {self.pages_per_second:>7.2f}"
        )


HEADER = (
    f"{'method':<16} {'size':<9} {'steps':>6} {'AIR':>8} {'own-MI':>7} {'over-claim':>10} {'kB':>6} {'own-kB':>6} "
    + "".join(f"{name:>7} " for name in WALLS)
    + f"{'of oracle':>10} {'of theirs':>10} {'gained':>8}  {'features':>9} {'training':>8} {'pages/s':>7}"
)
"""Held-out pages, bits a symbol and kB a page; own-MI and the over-claim, own-MI less AIR, concentrations multiplied by
one factor that the validation pages ask for; AIR where a symbol's light meets no wall of the pipe, a wall of pair x,
of pair y, or of both; AIR over the oracle's, and over that of the best published decoder; of the last pass alone, as
its steps: what validation AIR gained in the last fifth of them (`FOOTNOTE`), minutes of features and of training, and
pages it trained on a second, validation counted as time: of a kept method, on the machine that trained it. The size is
that of the first pass's network."""

UNSETTLED = "*"
FOOTNOTE = (
    f"{UNSETTLED} still learning: validation AIR gained {SETTLED_BITS} bit or more in the last {LAST_SHARE:.0%} of the"
    " steps; no comparison with it counts yet"
)
