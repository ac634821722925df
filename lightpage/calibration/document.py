"""The calibration document: what calibration found of one device, as checked TOML."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, field_serializer

from lightpage.calibration.calibrate import Registered
from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.goodness.causes import unlike_profile, with_unread
from lightpage.calibration.goodness.remedies import DUST, UNKNOWN, largest
from lightpage.calibration.goodness.verdict import GOOD, GOOD_SHARE, NOT_JUDGED, USABLE, Goodness, Reading
from lightpage.calibration.likelihood.statistics import Statistics
from lightpage.calibration.parameters import KNOWN, NAMES, as_dict, as_vector
from lightpage.device.profile import Count, Finite, Profile, TomlTable, to_toml, validate
from lightpage.errors import CalibrationError, ProfileError
from lightpage.files import read_text, replace_text
from lightpage.page import modulation as modulations
from lightpage.page.modulation import NOMINAL, Modulation
from lightpage.progress import warn
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.pixels.blemishes import Blemishes
from lightpage.words import brief, counted

Real = NDArray[np.float64]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
NonNegativeCount = Annotated[int, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
PageHash = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
DEFAULT_PAGES = 2
"""Number of known pages that a device is calibrated with."""
_LATER = NAMES[KNOWN[0] :]
_ADDED = {
    "parameters": {"lens_path_relative": -1.0, **dict.fromkeys(_LATER, 0.0)},
    "deviations": dict.fromkeys(("lens_path_relative", *_LATER), 0.0),
    "modulation": dict.fromkeys(modulations.CROSSTALK, 0.0),
    "modulation_deviations": dict.fromkeys(modulations.CROSSTALK, 0.0),
}
"""Fields that older documents lack: they took lenses for ideal, planes for those of the profile, and symbols for
independent of those beside them."""


_OPTIONAL = ("turn_deviation_rad", "coherence_at_first", "goodness", "reading", "statistics", "blemishes")


def _names_problem(values: dict[str, Any], names: tuple[str, ...] = NAMES) -> str:
    """Name the parameters that are missing or unknown, in words; empty when they are just those wanted."""
    missing = [name for name in names if name not in values]
    unknown = sorted(set(values) - set(names))
    parts = [("no " + ", ".join(missing)) if missing else "", ("unknown " + ", ".join(unknown)) if unknown else ""]
    return "; ".join(part for part in parts if part)


def _just(names: tuple[str, ...]) -> AfterValidator:
    """Check that a table has these names, and put it into their order."""

    def ordered(values: dict[str, float]) -> dict[str, float]:
        if problem := _names_problem(values, names):
            raise ValueError(problem)
        return {name: values[name] for name in names}

    return AfterValidator(ordered)


class BlemishCounts(TomlTable):
    """Numbers of pixels whose blemishes were corrected.

    Attributes:
        in_phase_lost, quadrature_lost: pixels without a signal, such as hot ones.
        in_phase_shaded, quadrature_shaded: pixels behind dust.
    """

    in_phase_lost: NonNegativeCount = 0
    in_phase_shaded: NonNegativeCount = 0
    quadrature_lost: NonNegativeCount = 0
    quadrature_shaded: NonNegativeCount = 0

    @classmethod
    def of(cls, blemishes: Blemishes) -> Self:
        """Count the blemishes of both cameras."""
        in_phase_lost, quadrature_lost = blemishes.lost
        in_phase_shaded, quadrature_shaded = blemishes.shaded
        return cls(
            in_phase_lost=in_phase_lost,
            in_phase_shaded=in_phase_shaded,
            quadrature_lost=quadrature_lost,
            quadrature_shaded=quadrature_shaded,
        )

    def __str__(self) -> str:
        """Numbers of the in-phase and of the quadrature camera in words, empty where there are none."""
        parts = [
            f"{in_phase} and {quadrature} pixels {what}"
            for in_phase, quadrature, what in (
                (self.in_phase_lost, self.quadrature_lost, "without a signal"),
                (self.in_phase_shaded, self.quadrature_shaded, "behind dust"),
            )
            if in_phase or quadrature
        ]
        return f"corrected (in-phase and quadrature camera): {', '.join(parts)}" if parts else ""


class Calibration(TomlTable):
    """Fitted geometry of one device against its nominal profile.

    Attributes:
        schema_version: 1.
        profile_name: name of the nominal profile that the numbers deviate from.
        turn_rad: angle between the homodyne arms, radians: 90 degrees plus error, negative when Q is inverted.
        turn_deviation_rad: standard deviation of that angle; None in documents of before.
        coherence_before, coherence_after: coherence of the known pages at nominal and at fitted geometry, 0 to 1.
        coherence_at_first: `coherence_after` of the calibration from nominal, where this is a re-fit that followed it.
        cost: mean squared normalised residual of the fit, about 1 when the twin explains the measurements.
        significant: share of the measured patches that were found, 0 to 1.
        pages_used: known pages that were fitted on or judged by.
        calibrated_pages: their SHA-256 (`hash_frames`), so that no figure counts them as held out.
        parameters: fitted value of every parameter of `lightpage.calibration.parameters`, in the unit of its name.
        deviations: their standard deviations, same names and units.
        modulation: light that the modulator makes of its levels, by the names of `lightpage.page.modulation`; nominal
            in documents that do not tell it.
        modulation_deviations: standard deviations of that, same names.
        goodness: how well the fit explains the light; None where that was not measured, as in documents of before.
        reading: what was read of known pages; None where none was read.
        statistics: statistics of the light and of the cameras' counts; None in documents of before.
        blemishes: numbers of the cameras' blemishes that were corrected; None in documents of before.
    """

    schema_version: Literal[1] = 1
    profile_name: Annotated[str, Field(min_length=1)]
    turn_rad: Finite
    turn_deviation_rad: NonNegative | None = None
    coherence_before: Share
    coherence_after: Share
    coherence_at_first: Share | None = None
    cost: NonNegative
    significant: Share
    pages_used: Count
    calibrated_pages: Annotated[tuple[PageHash, ...], Field(strict=False)]  # TOML knows lists alone
    parameters: Annotated[dict[str, Finite], _just(NAMES)]
    deviations: Annotated[dict[str, NonNegative], _just(NAMES)]
    modulation: Annotated[dict[str, Finite], _just(modulations.NAMES)] = NOMINAL.as_dict()
    modulation_deviations: Annotated[dict[str, NonNegative], _just(modulations.NAMES)] = NOMINAL.as_dict()
    goodness: Goodness | None = None
    reading: Reading | None = None
    statistics: Statistics | None = None
    blemishes: BlemishCounts | None = None

    def __repr__(self) -> str:
        verdict = "" if self.goodness is None else f", a {self.goodness.verdict} fit"
        found = f"coherence {self.coherence_after:.3f}{verdict}"
        return brief(self, f"of profile {self.profile_name}", found, f"by {counted(self.pages_used, 'page')}")

    __str__ = __repr__  # pydantic's own tells a hundred numbers

    @field_serializer("calibrated_pages")
    def _as_list(self, pages: tuple[str, ...]) -> list[str]:
        return list(pages)

    @classmethod
    def from_registered(
        cls,
        registered: Registered,
        profile: Profile,
        hashes: Sequence[str],
        statistics: Statistics | None = None,
        blemishes: BlemishCounts | None = None,
    ) -> Self:
        """The document of a registration.

        Args:
            registered: outcome of the registration.
            profile: the nominal device.
            hashes: SHA-256 of the known pages, one each.
            statistics: statistics of the light and of the counts, where they were measured.
            blemishes: numbers of the cameras' blemishes, where they were searched.
        """
        return cls(
            profile_name=profile.name,
            turn_rad=float(registered.quadrature_phase),
            turn_deviation_rad=registered.quadrature_deviation,
            coherence_before=float(registered.coherence_before),
            coherence_after=float(registered.coherence_after),
            cost=float(registered.cost),
            significant=float(registered.significant),
            pages_used=len(hashes),
            calibrated_pages=tuple(hashes),
            parameters=as_dict(registered.parameters),
            deviations=as_dict(registered.deviations),
            modulation=registered.modulation.as_dict(),
            modulation_deviations=Modulation(registered.modulation_deviations).as_dict(),
            goodness=registered.goodness,
            statistics=statistics,
            blemishes=blemishes,
        )

    def followed_by(self, fitted: Self) -> Self:
        """A re-fit that started here, with what it has to remember of this one.

        It remembers the coherence at first, so that many small losses are not taken for none, and the pages of every
        earlier fit, so that no figure counts one of them as held out. Statistics and blemishes that the re-fit has not
        measured stay.
        """
        return fitted.model_copy(
            update={
                "coherence_at_first": self.reference_coherence,
                "calibrated_pages": (*self.calibrated_pages, *fitted.calibrated_pages),
                "goodness": self.of_refit(fitted.goodness),
                "statistics": fitted.statistics or self.statistics,
                "blemishes": fitted.blemishes or self.blemishes,
            }
        )

    def of_refit(self, goodness: Goodness | None) -> Goodness | None:
        """Goodness of a re-fit that started here, by the light that it leaves unexplained.

        Where pages that were read have judged the device, or nothing has, an estimate does not call its re-fit wrong:
        held-back pages judge it.
        """
        judged = self.reading is not None or (self.goodness is not None and self.goodness.verdict == NOT_JUDGED)
        if goodness is None or goodness.verdict != "wrong" or not judged:
            return goodness
        return goodness.model_copy(update={"verdict": NOT_JUDGED})

    @property
    def reference_coherence(self) -> float:
        """The coherence that later fits are measured by: that of the calibration from nominal."""
        return self.coherence_after if self.coherence_at_first is None else self.coherence_at_first

    @property
    def behind_late_dust(self) -> bool:
        """Return whether dust that the references do not show is among the causes of what is lost."""
        return self.goodness is not None and any(cause.name == DUST for cause in self.goodness.causes)

    @property
    def fitted(self) -> frozenset[str]:
        """Names of the parameters that were fitted; the others, as the lenses' path where they are ideal, were held."""
        return frozenset(name for name, deviation in self.deviations.items() if deviation > 0)

    @property
    def vector(self) -> Real:
        """The fitted parameters as a ray twin takes them, [P]."""
        return as_vector(self.parameters)

    @property
    def modulator(self) -> Modulation:
        """Modulation that was fitted: the complex light of each level."""
        return Modulation(tuple(self.modulation.values()))

    def device(self, profile: Profile, references: FramePair) -> CalibratedDevice:
        """The device that was found, with its reference-only frames."""
        return CalibratedDevice(profile, self.vector, self.turn_rad, references, self.modulator)

    def angle_deg(self, profile: Profile) -> float:
        """Angle of the pipe, degrees: the profile's and what was fitted on top."""
        return profile.pipe.angle_deg + float(np.rad2deg(self.parameters["pipe_angle_rad"]))

    def judged(self, reading: Reading | None) -> Self:
        """The calibration with the verdict of known pages.

        Args:
            reading: what was read of them; None where no page was read, which leaves the fit not judged.
        """
        goodness = self.goodness
        if goodness is None:
            return self
        verdict = NOT_JUDGED if reading is None else reading.verdict
        if reading is None or verdict == NOT_JUDGED:
            judged = goodness.model_copy(update={"verdict": verdict})
            return self.model_copy(update={"goodness": judged, "reading": reading})
        lost = max(0.0, reading.light_bits - reading.air_bits)
        causes = with_unread(goodness.causes, reading, self.vector)
        other_profile = unlike_profile(self.vector)
        named = sum(cause.bits for cause in causes if cause.name != UNKNOWN)
        # what looks like noise of the modulator lowers the information of the light as well
        if verdict == "good" and (other_profile or named > (1 - GOOD_SHARE) * reading.light_bits):
            verdict = "usable"
        cause = "" if verdict == "good" else other_profile or goodness.cause or largest(causes)
        judged = goodness.model_copy(update={"verdict": verdict, "bits_lost": lost, "cause": cause, "causes": causes})
        return self.model_copy(update={"goodness": judged, "reading": reading})

    def contradicted(self, cause: str) -> Self:
        """The calibration as a wrong one, for a cause in words."""
        goodness = self.goodness
        wrong = None if goodness is None else goodness.model_copy(update={"verdict": "wrong", "cause": cause})
        return self.model_copy(update={"goodness": wrong, "reading": None})

    @property
    def verdict_sentence(self) -> str:
        """The verdict in words; empty where the fit was not measured."""
        if self.goodness is None:
            return ""
        judged = self.goodness.verdict != NOT_JUDGED
        verdict = f"a {self.goodness.verdict} fit" if judged else f"{NOT_JUDGED}, for want of further known pages"
        lost = f"about {self.goodness.bits_lost:.2f} bit a symbol lost to light that the fit does not explain"
        return f"{verdict}: {lost if self.reading is None else self.reading}"

    @property
    def is_wrong(self) -> bool:
        """Return whether the fit is wrong: it reads nothing, or leaves too much light unexplained."""
        return self.goodness is not None and self.goodness.verdict == "wrong"

    def check_good(self, subject: str, remedy: str = "; mend the cause and calibrate anew") -> None:
        """Check that the fit is not wrong; a warning where it is only usable, or may be.

        Args:
            subject: name of the thing that has the calibration.
            remedy: advice that follows the limit in the message.

        Raises:
            CalibrationError: it is wrong.
        """
        goodness = self.goodness
        reading = self.reading
        if goodness is None or goodness.verdict == "good":
            return
        if goodness.verdict == NOT_JUDGED:
            if goodness.bits_lost >= GOOD:
                warn(f"{subject}: about {goodness.bits_lost:.2f} bit a symbol may be lost: {goodness.cause}")
            return
        cause = f": {goodness.cause}" if goodness.cause else ""
        lost = f"which costs about {goodness.bits_lost:.2f} bit a symbol" if reading is None else str(reading)
        got = f"a {goodness.verdict} fit, {lost}{cause}"
        if goodness.verdict == "wrong":
            expected = f"at most {USABLE:g} bit" if reading is None else "pages that some code carries"
            raise CalibrationError(subject, got, f"{expected}{remedy}")
        warn(f"{subject}: {got}")

    def check_profile(self, profile: Profile) -> None:
        """Check that the calibration belongs to devices of `profile`.

        Raises:
            ProfileError: it was made for another profile.
        """
        if self.profile_name != profile.name:
            raise ProfileError(
                "calibration: profile_name", repr(self.profile_name), f"{profile.name!r}, the profile in use"
            )

    def to_toml(self) -> str:
        """The document as TOML text; `parse_calibration` reads it back to an equal calibration."""
        return to_toml(self, without=[name for name in _OPTIONAL if getattr(self, name) is None])

    def save(self, path: str | Path) -> None:
        """Write the document, replacing what is there in one step.

        Raises:
            InvalidInputError: the path cannot be written.
        """
        replace_text(path, self.to_toml(), "calibration file")


def parse_calibration(text: str, source: str = "calibration") -> Calibration:
    """Read a calibration from TOML text.

    Raises:
        ProfileError: not TOML, or a missing, unknown or unphysical key; the message names it.
    """
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ProfileError(source, f"text that is not TOML ({error})", "a TOML document") from None
    for table, added in _ADDED.items():
        if isinstance(values := data.get(table), dict):
            data[table] = added | values
    for table in ("parameters", "deviations"):
        values = data.get(table)
        problem = _names_problem(values) if isinstance(values, dict) else ""
        if problem:
            raise ProfileError(f"{source}: [{table}]", problem, "every parameter of the ray twin and no other")
    return validate(Calibration, data, source)


def load_calibration(path: str | Path) -> Calibration:
    """Read a calibration from a TOML file.

    Raises:
        ProfileError: unreadable, not TOML, or a missing, unknown or unphysical key; the message names it.
    """
    subject = f"calibration file {path}"
    return parse_calibration(read_text(path, subject, "a readable TOML file", ProfileError), subject)
