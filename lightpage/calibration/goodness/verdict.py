"""The verdict on a fit: how much of the light it explains, and what it costs."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from lightpage.device.profile import TomlTable

NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Map = list[list[NonNegative]]
Verdict = Literal["good", "usable", "wrong"]

GOOD = 0.1
USABLE = 0.3
"""Bits a symbol below which a fit is called so, lost against a fit that explains all light."""


class Goodness(TomlTable):
    """Goodness of fit: how well a calibration explains the light of a known page.

    Attributes:
        verdict: good, usable or wrong, by `bits_lost`; a device whose lengths are not its profile's is not good.
        bits_lost: bits a symbol that the standard decoder loses against one whose model explains all light, estimated.
        unexplained_relative: power of what a better model would explain, over the signal's, symbol by symbol.
        noise_relative: power of all noise, over the signal's: that of the frames and that of the modulator.
        modulator_noise_rad: noise of phase of the modulator, a sample of `symbol_samples`.
        by_page: power of the residual over that of noise, in blocks over the page, rows from the top; 1 is noise alone.
        by_facet: the same over the pipe's exit facet.
        cause: likeliest error, in words; empty where nothing is wrong.
    """

    verdict: Verdict
    bits_lost: NonNegative
    unexplained_relative: NonNegative
    noise_relative: NonNegative
    modulator_noise_rad: NonNegative
    by_page: Map
    by_facet: Map
    cause: str
