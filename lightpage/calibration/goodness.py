"""How well a fitted device explains the light of a known page: in bits, by place, and what is likeliest to be wrong.

The light that the fitted waves predict of a known page is taken off the light that was recovered. What is left is sent
back to the modulator, where it is an error of each symbol, as a decoder would meet it that knows all other symbols.
Noise of the frames makes such errors, which is measured by adding noise to the frames once more; noise of the modulator
makes errors of phase and none of amplitude. Light that the model has in another place is as much of the one as of the
other: so the errors of amplitude, beyond what noise leaves, say how much of the light is unexplained.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Literal, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray
from pydantic import Field

from lightpage.calibration.frame_noise import with_more_noise
from lightpage.calibration.parameters import NAMES
from lightpage.calibration.waves.wave_model import FittedWaves, illumination_terms, on_modulator
from lightpage.device.profile import Profile, TomlTable
from lightpage.page.modulation import Modulation
from lightpage.recording.frame_pair import FramePair
from lightpage.waves.grid import symbol_samples

Real = NDArray[np.float64]
Complex = NDArray[np.complexfloating]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Map = list[list[NonNegative]]
Verdict = Literal["good", "usable", "wrong"]
RecoverField = Callable[[FramePair, FramePair], Complex]
"""Frames and references to the field on the common grid, with the fitted cameras."""

GOOD, USABLE = 0.1, 0.3
"""Bits a symbol that a fit may lose against one that explains all light, to be called so."""
_MORE_NOISE = 3.0
"""Times the frames' own noise: rounding to whole counts, which adds some, then hardly counts."""
_STRIDE = 4
"""Samples of the common grid from one to the next by which corrections are fitted: few unknowns need few equations."""
_SMOOTHED = 9
"""Symbols, side of the squares over whose mean a symbol's error does not count: a network learns what is smooth."""
_BLOCKS = (6, 8)
"""Rows and columns of the maps."""


class Goodness(TomlTable):
    """How well a fit explains the light.

    Attributes:
        verdict: good, usable or wrong, by `bits_lost`.
        bits_lost: bits a symbol that a decoder loses against one whose model explains all light; an estimate.
        unexplained_relative: power of the light that the model leaves unexplained, over the signal's.
        noise_relative: power of the noise in the recovered light, over the signal's.
        by_page: unexplained light over noise, in blocks over the page, rows from the top.
        by_facet: the same over the pipe's exit facet.
        cause: what is likeliest to be wrong, in words; empty where nothing is.
    """

    verdict: Verdict
    bits_lost: NonNegative
    unexplained_relative: NonNegative
    noise_relative: NonNegative
    by_page: Map
    by_facet: Map
    cause: str


class _Seen(NamedTuple):
    """A known page's light as it was recovered and as the model has it.

    Attributes:
        waves: the fitted ones.
        shown: light on the modulator, even illumination, [ny samples, nx samples].
        field: recovered, on the common grid [Gy, Gx].
    """

    waves: FittedWaves
    shown: Complex
    field: Complex
