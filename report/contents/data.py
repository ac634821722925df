"""Data that a report shows, whichever source they were read from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from lightpage.calibration.document import Calibration
from lightpage.device.lenses import LensPrescription
from lightpage.device.profile import Profile
from lightpage.metrics.information import page_kilobytes
from lightpage.metrics.measures import PageMeasures, SymbolMaps
from lightpage.metrics.reliability import ConcentrationBin, ConfidenceBin
from lightpage.recording.frame_pair import FramePair
from lightpage.report.json_file import Part

if TYPE_CHECKING:
    from lightpage.train.fitting.curves import Curve

Real = NDArray[np.float64]


@dataclass(frozen=True)
class Golden:
    """A frame pair and the phase that is decoded from it, radians [ny, nx], piston removed."""

    pair: FramePair
    phase: NDArray[np.floating]


class Walk(Part):
    """Walk of a quantity from page to page.

    Attributes:
        values: its value on each page; None where a page does not show it.
        step: root mean square of its change from a page to the next.
    """

    values: list[float | None]
    step: Annotated[float, Field(ge=0)]


@dataclass(frozen=True)
class Rays:
    """Parameters of the optics that rays are drawn through.

    Attributes:
        angle_deg: angle of the pipe.
        origin: whose angle that is.
        lens: prescription of both lenses; None for ideal ones.
        own: whether the decoder trained the angle itself.
    """

    angle_deg: float
    origin: str
    lens: LensPrescription | None = None
    own: bool = False


@dataclass(frozen=True)
class ReportData:
    """Everything that a report shows. For what is missing stands a sentence that says why.

    Attributes:
        title: title of the page.
        pages: sentences that say which pages were measured.
        facts: decoder and provenance, (name, value).
        profile, calibration: nominal and fitted device.
        rays: parameters of the optics that rays are drawn through.
        measures: over the data symbols of all pages together.
        maps: means over the pages at every place.
        confidence_bins, concentration_bins: claims against results.
        curves: curves of the training, by TensorBoard's tag, for each validation at the light; None of an evaluation.
        golden: golden page with its decoded phase.
        drift: drift of the device over the measured pages by quantity; empty where it is not known.
    """

    title: str
    pages: str
    facts: list[tuple[str, str]]
    profile: Profile
    calibration: Calibration
    rays: Rays
    measures: PageMeasures
    maps: SymbolMaps
    confidence_bins: list[ConfidenceBin]
    concentration_bins: list[ConcentrationBin]
    curves: Sequence[Mapping[str, Curve]] | str | None
    golden: Golden | str
    drift: Mapping[str, Walk] = field(default_factory=dict)

    @property
    def data(self) -> NDArray[np.bool_]:
        """Mask of the data symbols, bool [ny, nx]."""
        return np.isfinite(self.maps.air)

    @property
    def page_kb(self) -> float:
        """Kilobytes that a page carries, by its AIR."""
        return page_kilobytes(self.measures.air_bits_per_symbol, int(np.count_nonzero(self.data)))

    @property
    def summary(self) -> str:
        """Headline figure, in a few words."""
        return f"AIR {self.measures.air_bits_per_symbol:.3f} bit/symbol"
