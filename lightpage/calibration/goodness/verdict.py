"""The verdict on a fit: how much of the light it explains, and how much is read of pages that it has not seen."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from lightpage.device.profile import TomlTable
from lightpage.words import counted

NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Map = list[list[NonNegative]]
Verdict = Literal["good", "usable", "wrong", "not judged"]

NOT_JUDGED: Verdict = "not judged"
GOOD = 0.1
USABLE = 0.3
"""Bits a symbol below which a fit that was not judged by a reading is called so, lost against a fit that explains all
light."""
GOOD_SHARE = 0.95
"""Share of the bits that light holds from which a reading is good."""


class Reading(TomlTable):
    """Reading of known pages by the fitted waves.

    Attributes:
        in_sample: whether these are pages of the fit, as no others were left. They do not judge it.
        pages: number of pages.
        air_bits: achievable information rate (AIR), bits a symbol; pages that are refused count with zero.
        air_standard_error_bits: its standard error.
        light_bits: information of the light by its Fisher information, bits a symbol.
        user_bytes: user bytes of a page by the chosen code; 0 where no code carries the pages.
        drift: root mean square of the change from a page to the next, by what changes: a phase in rad, a place in px, a
            relative stroke or brightness. Empty where fewer than two pages show it, and in documents of before.
    """

    in_sample: bool
    pages: Annotated[int, Field(gt=0)]
    air_bits: Annotated[float, Field(allow_inf_nan=False)]
    air_standard_error_bits: NonNegative
    light_bits: Annotated[float, Field(gt=0, allow_inf_nan=False)]
    user_bytes: Annotated[int, Field(ge=0)]
    drift: dict[str, NonNegative] = Field(default_factory=dict)

    def __str__(self) -> str:
        """Sentence that states the reading."""
        return (
            f"{counted(self.pages, 'page')} that the fit has {'' if self.in_sample else 'not '}seen: "
            f"{self.air_bits:.3f} +- {self.air_standard_error_bits:.3f} bits a symbol read, {self.share:.2f} of the "
            f"{self.light_bits:.2f} that their light holds; {self.user_bytes:,} user bytes a page"
        )

    @property
    def share(self) -> float:
        """AIR over the information of the light."""
        return self.air_bits / self.light_bits

    @property
    def verdict(self) -> Verdict:
        """Good from `GOOD_SHARE` of the light's information on, usable where a code carries the pages, else wrong.

        Pages of the fit can only show that it is wrong.
        """
        is_good = self.share >= GOOD_SHARE
        if not is_good and not self.user_bytes:
            return "wrong"
        if self.in_sample:
            return NOT_JUDGED
        return "good" if is_good else "usable"


class Cause(TomlTable):
    """Cause of light that a fit does not explain, or of light that the device loses.

    Attributes:
        name: name of the cause, see `lightpage.calibration.goodness.remedies`.
        bits: information that it costs, bits a symbol, estimated.
        what: the cause in words, with its places.
        remedy: what a user can do about it.
    """

    name: str
    bits: NonNegative
    what: str
    remedy: str


class Goodness(TomlTable):
    """Goodness of fit: how well a calibration explains the light of a known page.

    Attributes:
        verdict: good, usable or wrong, by `bits_lost`, or by a `Reading`; a device whose lengths are not its profile's
            is not good.
        bits_lost: bits a symbol that the standard decoder loses against one whose model explains all light, estimated;
            where pages were read, what they lose against the information of their light.
        unexplained_relative: power of what a better model would explain, over the signal's, symbol by symbol.
        noise_relative: power of all noise, over the signal's: that of the frames and that of the modulator.
        modulator_noise_rad: noise of phase of the modulator, a sample of `symbol_samples`.
        frame_error_rad, modulator_error_rad: standard deviations of a symbol's phase by the noise of frames and
            modulator; None in documents of before.
        by_page: power of the residual over that of noise, in blocks over the page, rows from the top; 1 is noise alone.
        by_facet: the same over the pipe's exit facet.
        cause: largest cause, in words; empty where nothing is wrong.
        causes: causes of what is lost, the largest first, and what is unknown last; empty where none was found, and in
            documents of before.
    """

    verdict: Verdict
    bits_lost: NonNegative
    unexplained_relative: NonNegative
    noise_relative: NonNegative
    modulator_noise_rad: NonNegative
    by_page: Map
    by_facet: Map
    cause: str
    frame_error_rad: NonNegative | None = None
    modulator_error_rad: NonNegative | None = None
    causes: Annotated[tuple[Cause, ...], Field(strict=False)] = ()
