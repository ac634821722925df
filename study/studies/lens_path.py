"""The optical path of a real lens beyond the ideal one's: traced, and what its terms leave of it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray

from lightpage.device.lens_path import SeidelTerms
from lightpage.device.lenses import LENSES, LensPrescription, lens_of_length
from lightpage.device.profile import LensPath, Profile
from lightpage.progress import Progress
from lightpage.study.study import Case, Result, Row, Settings, Study
from lightpage.train.published.rays import launched_path

Real = NDArray[np.float64]
_RAYS = 4000
_CURVES = (-1.0, 0.0, 1.0)
"""Places on the facet of the drawn curves, over half its width."""
_SAMPLES = 60


class FittedPath(NamedTuple):
    """A lens's path by its terms.

    Attributes:
        path: the terms, as a profile states them.
        spread_rad: standard deviation of the traced path over page and facet.
        left_rad: the same of what the terms leave.
    """

    path: LensPath
    spread_rad: float
    left_rad: float


def fitted_path(profile: Profile, lens: LensPrescription, seed: int = 0) -> FittedPath:
    """Least squares of the terms to rays from all over the page to all over the pipe's facet."""
    half_page = np.array([profile.page_width_m, profile.page_height_m]) / 2
    share = np.random.default_rng(seed).uniform(-1, 1, (_RAYS, 4))
    field, aperture = share[:, :2] * half_page, share[:, 2:] * profile.pipe.width_m / 2
    facet, beyond = _traced(profile, lens, field, aperture)
    terms = [
        profile.model_copy(update={"lens_path": LensPath(**{name: 1.0})}).seidel_terms()
        for name in LensPath.model_fields
    ]
    columns = np.stack([*(_path(one, field, facet) for one in terms), np.ones(_RAYS)], axis=1)
    found = np.linalg.lstsq(columns, beyond, rcond=None)[0]
    terms_rad: dict[str, Any] = dict(zip(LensPath.model_fields, map(float, found), strict=False))
    path = LensPath.model_construct(**terms_rad)  # unchecked: it may be more than a profile may state
    return FittedPath(path, float(beyond.std()), float((beyond - columns @ found).std()))


def _traced(profile: Profile, lens: LensPrescription, field: Real, aperture: Real) -> tuple[Real, Real]:
    """Trace rays from the page towards the facet: return their places there, [N, 2], and path beyond the ideal, [N]."""
    wave_number = 2 * np.pi / profile.light.wavelength_m
    arrived, length = (
        tensor.numpy()
        for tensor in launched_path(lens, torch.from_numpy(field), torch.from_numpy(aperture / lens.effective_focal_m))
    )
    ideal = -(field * arrived).sum(1) / lens.effective_focal_m
    return arrived, wave_number * (length - ideal)


def _path(terms: SeidelTerms, field: Real, facet: Real) -> Real:
    at = field[:, 0], field[:, 1]
    return np.asarray(terms.of_field(*at) + terms.of_both(*at, facet[:, 0], facet[:, 1]))


def _cases(settings: Settings) -> list[Case]:
    lens = lens_of_length(settings.profile.lens.focal_length_m)
    return [{"name": lens.name if lens else "ideal"}]


def _measure(settings: Settings, case: Case, work: Path, progress: Progress) -> Result:
    profile, lens = settings.profile, LENSES.get(case["name"])
    radii = np.linspace(0, profile.corner_m, _SAMPLES)
    if lens is None:
        flat = np.zeros((len(_CURVES), _SAMPLES))
        return LensPath().model_dump() | {"spread_rad": 0.0, "left_rad": 0.0, "traced": flat, "terms": flat}
    found = fitted_path(profile, lens, settings.seed)
    terms = profile.model_copy(update={"lens_path": found.path}).seidel_terms()
    traced, by_terms = [], []
    field = np.stack([radii, np.zeros(_SAMPLES)], axis=1)
    for share in _CURVES:
        facet, beyond = _traced(profile, lens, field, np.tile([share * profile.pipe.width_m / 2, 0.0], (_SAMPLES, 1)))
        traced.append(beyond)
        by_terms.append(_path(terms, field, facet))
    return found.path.model_dump() | {
        "spread_rad": found.spread_rad,
        "left_rad": found.left_rad,
        "traced": np.array(traced),
        "terms": np.array(by_terms),
    }


def _rows(cases: Sequence[Case], results: Sequence[Result]) -> list[Row]:
    return [
        (case["name"], *(float(result[name]) for name in (*LensPath.model_fields, "spread_rad", "left_rad")))
        for case, result in zip(cases, results, strict=True)
    ]


def _plot(settings: Settings, cases: Sequence[Case], results: Sequence[Result]) -> Figure:
    figure = Figure(figsize=(6.5, 4.2), layout="constrained")
    axis = figure.subplots()
    radii = np.linspace(0, settings.profile.corner_m, _SAMPLES) * 1e3
    for case, result in zip(cases, results, strict=True):
        for share, traced, terms, colour in zip(_CURVES, result["traced"], result["terms"], "brg", strict=True):
            axis.plot(radii, traced, colour, label=f"facet at {share:+g} of half its width")
            axis.plot(radii[::4], terms[::4], colour + ".")
        axis.set_title(f"{case['name']}: traced (lines), by the terms (dots)")
    axis.set_xlabel("distance of the symbol from the page's centre, mm")
    axis.set_ylabel("path beyond the ideal lens, radians")
    axis.legend()
    return figure


STUDY = Study(
    title="what a real lens adds to the phase",
    source="beyond the paper: supplement S10 traces where its rays land",
    cases=_cases,
    measure=_measure,
    header=(
        "lens",
        "piston",
        "distortion",
        "astigmatism",
        "field curvature",
        "coma",
        "spherical",
        "traced, std",
        "left, std",
    ),
    rows=_rows,
    plot=_plot,
)
