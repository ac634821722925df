"""A report's contents from the JSON of `lightpage evaluate`."""

from __future__ import annotations

import hashlib
import io
import zipfile
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from lightpage.calibration.document import parse_calibration
from lightpage.device.profile import parse_profile
from lightpage.errors import InvalidInputError
from lightpage.metrics.measures import PageMeasures, SymbolMaps
from lightpage.metrics.reliability import ConcentrationBin, ConfidenceBin
from lightpage.page.levels import MAX_LEVELS, MIN_LEVELS
from lightpage.page.pilots import remove_piston
from lightpage.recording.frame_pair import FramePair
from lightpage.report.contents.data import Golden, Rays, ReportData, Walk
from lightpage.report.json_file import Bits, JsonFile, Part, Seconds, Share
from lightpage.report.words import how_long
from lightpage.words import counted

Rows = list[list[float | None]]

_GOLDEN = "golden.npz"


class _Maps(Part):
    air: Rows
    own_mi: Rows
    error_rad: Rows


class _Bundle(Part):
    path: str
    name: str
    profile: str
    calibration: str
    metrics: dict[str, Any]
    provenance: dict[str, Any]
    golden_sha256: str
    golden_piston_rad: float


class _Evaluation(Part):
    """The keys of the JSON that a report is made of."""

    bundle_version: str
    pages: Annotated[int, Field(gt=0)]
    pages_left_out: Annotated[int, Field(ge=0)]
    symbols_per_page: Annotated[int, Field(gt=0)]
    levels: Annotated[int, Field(ge=MIN_LEVELS, le=MAX_LEVELS)]
    air_bits_per_symbol: Bits
    own_mi_bits_per_symbol: Bits
    gmi_bits_per_symbol: Bits | None
    symbol_error_rate: Share
    ece: Share
    seconds_per_page: Seconds
    concentration_bins: Annotated[list[ConcentrationBin], Field(min_length=1)]
    confidence_bins: Annotated[list[ConfidenceBin], Field(min_length=1)]
    maps: _Maps
    bundle: _Bundle
    refused_pages: list[dict[str, Any]]
    drift: Annotated[dict[str, Walk], Field(default_factory=dict)]


class _PageCount(Part):
    pages: int | None = None


def report_of_evaluation(file: JsonFile) -> ReportData:
    """Read the figures of an evaluation, and a page from its bundle if that is still there.

    Raises:
        InvalidInputError: not such a file, or maps of another shape than the bundle's page.
    """
    path, found = file.path, _checked(file)
    bundle = found.bundle
    profile = parse_profile(bundle.profile, f"evaluation {path}: profile")
    calibration = parse_calibration(bundle.calibration, f"evaluation {path}: calibration")
    maps = SymbolMaps(*(_page(path, rows, profile.page_shape) for rows in vars(found.maps).values()))
    return ReportData(
        title=f"Evaluation of bundle {bundle.name}, version {found.bundle_version}",
        pages=_pages(found),
        facts=_facts(found),
        profile=profile,
        calibration=calibration,
        rays=Rays(calibration.angle_deg(profile), "the calibrated angle"),
        measures=PageMeasures(
            count=found.pages * found.symbols_per_page,
            levels=found.levels,
            air_bits_per_symbol=found.air_bits_per_symbol,
            own_mi_bits_per_symbol=found.own_mi_bits_per_symbol,
            gmi_bits_per_symbol=found.gmi_bits_per_symbol,
            symbol_error_rate=found.symbol_error_rate,
            ece=found.ece,
        ),
        maps=maps,
        confidence_bins=found.confidence_bins,
        concentration_bins=found.concentration_bins,
        curves=None,
        golden=_golden(bundle),
        drift=found.drift,
    )


def _pages(found: _Evaluation) -> str:
    told = f"All figures are of {counted(found.pages, 'page')} that the bundle was neither calibrated nor trained on."
    if found.pages_left_out:
        told += f" Of the same recording, {counted(found.pages_left_out, 'page')} that it has seen are left out."
    if found.refused_pages:
        refused = counted(len(found.refused_pages), "page")
        told += f" Also left out: {refused} that could not be decoded or were not confirmed by the pilots."
    return told


def _checked(file: JsonFile) -> _Evaluation:
    if file.checked(_PageCount).pages == 0:
        raise InvalidInputError(f"{file.path}", "an evaluation that read no page", "one of pages that could be read")
    return file.checked(_Evaluation)


def _page(path: Path, rows: Rows, shape: tuple[int, int]) -> NDArray[np.float64]:
    """Return a map of the page as an array, NaN at pilots."""
    if {(len(rows), len(row)) for row in rows} != {shape}:
        got = f"{len(rows)} rows of {sorted({len(row) for row in rows})} symbols"
        raise InvalidInputError(f"{path}: maps", got, f"{shape[0]} rows of {shape[1]}, as the bundle's page has")
    return np.array(rows, dtype=np.float64)


def _golden(bundle: _Bundle) -> Golden | str:
    """Return the golden page, or a sentence where it is gone. docs/reference/formats.md has its layout."""
    path = Path(bundle.path)
    try:
        root = zipfile.Path(path) if path.is_file() else path
        data = (root / _GOLDEN).read_bytes()
    except (OSError, KeyError, zipfile.BadZipFile):
        return f"There are no frames: the bundle {path.name} can no longer be read where the evaluation found it."
    if hashlib.sha256(data).hexdigest() != bundle.golden_sha256:
        return f"There are no frames: what lies at {path.name} now is not the bundle that was evaluated."
    with np.load(io.BytesIO(data)) as arrays:
        px, py = arrays["p"]
        phase = remove_piston(np.arctan2(py, px), bundle.golden_piston_rad)
        return Golden(FramePair(arrays["in_phase"], arrays["quadrature"]), phase)


def _facts(found: _Evaluation) -> list[tuple[str, str]]:
    seconds, provenance = found.bundle.metrics.get("training_seconds"), found.bundle.provenance
    return [
        ("Bundle", f"{Path(found.bundle.path).name}, version {found.bundle_version}"),
        ("Training", how_long(seconds) if isinstance(seconds, int | float) else "time not noted"),
        ("Decoding", f"{1e3 * found.seconds_per_page:.0f} ms a page, median"),
        ("Trained by", str(provenance.get("command", "")) or "not noted"),
        ("Seed", "not noted" if provenance.get("seed") is None else str(provenance["seed"])),
        ("Commit", str(provenance.get("commit", "")) or "not noted"),
    ]
