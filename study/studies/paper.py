"""Study of the paper: its figures and tables, piece by piece in the order of their worth, and Lightpage beside them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from lightpage.progress import Progress
from lightpage.study.lights import DataSet
from lightpage.study.ours import TRAINING_PAGES, preset_trained
from lightpage.study.studies import (
    angle,
    cross_section,
    drift,
    folding,
    imaging_condition,
    pipe_length,
    rays,
    receptive_field,
    symbol_size,
)
from lightpage.study.study import Case, Result, Row, Settings, Study, load_result, measured, written
from lightpage.train.models.presets import ACCURATE, STANDARD

_PRESET, _BOUND = "preset", "bound"
_BOUND_OF = {"pages": 4, "symbols": 100}
"""Pages, and symbols of each: the bound is then known to some thousandths of a bit."""
_QUICK_BOUND_OF = {"pages": 1, "symbols": 3}
_MORE_PAGES = (450, 1000, 2000)
"""Pages that `accurate` is trained on in pieces by name: what more of them bring."""
_LEARNING = {"symbol-size": symbol_size.STUDY, "angle": angle.STUDY, "pipe-length": pipe_length.STUDY}
"""Studies whose cases are pieces of their own, since each trains a decoder."""
_WHOLE = {
    "rays": rays.STUDY,
    "folding": folding.STUDY,
    "cross-section": cross_section.STUDY,
    "imaging-condition": imaging_condition.STUDY,
    "receptive-field": receptive_field.STUDY,
    "drift": drift.STUDY,
}
"""Studies that are a piece each, with a table and a picture of their own in its folder."""
_ANGLE = ("none", "ray-matched")
"""Its cases that are pieces; `ray` is the piece `ray-4x4`."""
_REPORTED_KB = {"mode-4x4": 19.0, "ray-4x4": 25.0, "mode-2x2": 46.0, "ray-2x2": 66.0}
"""What its authors report of their bench, kB a page by own-MI."""
_COLUMNS = ("own_mi_claimed", "air_kB", "own_mi_claimed_kB", "user_bytes")
_SHOWN = 12
"""Most maps of a picture."""


def _cases(settings: Settings) -> list[Case]:
    cases = {name: {str(case["name"]): case for case in study.cases(settings)} for name, study in _LEARNING.items()}

    def published(size: int) -> list[Case]:
        names = [f"{localizer}-{size}x{size}" for localizer in symbol_size.LOCALIZERS]
        return [_piece("figure 3", "symbol-size", cases["symbol-size"][n]) for n in names if n in cases["symbol-size"]]

    def ours(size: int) -> list[Case]:
        usual = {"size": size, "pages": TRAINING_PAGES}
        chosen = [{"name": f"{preset}-{size}x{size}", "preset": preset, **usual} for preset in (STANDARD, ACCURATE)]
        return [_piece("beside figure 3", _PRESET, case) for case in chosen] + bound(size)

    def bound(size: int) -> list[Case]:
        count = _QUICK_BOUND_OF if settings.quick else _BOUND_OF
        return [_piece("beside figure 3", _BOUND, {"name": f"bound-{size}x{size}", "size": size, **count})]

    pieces = [*published(4), *ours(4)]
    if not settings.quick:
        pieces += [*published(2), *ours(2)]
    pieces.append(_piece("figure 4", "rays", {"name": "rays"}))
    if settings.quick:
        return pieces
    pieces += [_piece("figures 4C, 2C", "angle", case) for name, case in cases["angle"].items() if name in _ANGLE]
    pieces += [*published(16), *bound(16), *published(8), *bound(8)]
    pieces += [_piece("figure 5", "pipe-length", case) for case in cases["pipe-length"].values()]
    pieces += [_piece(study.source, name, {"name": name}) for name, study in _WHOLE.items() if name != "rays"]
    for pages in _MORE_PAGES:
        case = {"name": f"pages-{pages}", "preset": ACCURATE, "size": 4, "pages": pages}
        pieces.append({**_piece("beyond", _PRESET, case), "by_name": True})
    return pieces


def _piece(figure: str, study: str, case: Case) -> Case:
    return {"name": case["name"], "figure": figure, "study": study, "case": case}


def _measure(settings: Settings, case: Case, work: Path, progress: Progress) -> Result:
    name, inner = case["study"], case["case"]
    if name in (_PRESET, _BOUND):
        data_set = DataSet(settings.profile.with_symbols_of(inner["size"]), settings.device)
        if name == _PRESET:
            return preset_trained(settings, data_set, inner["preset"], inner["pages"], work, progress)
        mean, error = settings.lights.bound(data_set, inner["pages"], inner["symbols"], settings.seed, progress)
        return {"air": mean, "standard_error": error}
    if name in _LEARNING:
        result = _LEARNING[name].measure(settings, inner, work, progress)
        _draw(settings, name, {case["name"]: result}, work.parent)
        return result
    study = _WHOLE[name]
    cases = study.cases(settings)
    written(work, study, settings, cases, [measured(study, settings, each, work, progress) for each in cases])
    return {"cases": len(cases)}


def _draw(settings: Settings, name: str, found: dict[str, Result], results: Path) -> None:
    """Write table and picture of a study whose cases are pieces, into a folder of its name, once all are measured.

    Args:
        settings: settings of the study.
        name: name of that study.
        found: results by piece that are not kept yet.
        results: folder of the pieces' results.
    """
    study, known = _LEARNING[name], dict(found)
    cases = [case for case in study.cases(settings) if not case.get("by_name")]
    pieces = ["ray-4x4" if (name, case["name"]) == ("angle", "ray") else case["name"] for case in cases]
    for piece in pieces:
        path = results / f"{piece}.json"
        if piece not in known and path.exists():
            known[piece] = load_result(path)
    if known.keys() >= set(pieces):
        (results / name).mkdir(exist_ok=True)
        written(results / name, study, settings, cases, [known[piece] for piece in pieces])


def _rows(cases: Sequence[Case], results: Sequence[Result]) -> list[Row]:
    def number(result: Result, name: str) -> Any:
        return result.get(name, float("nan"))

    both = [*zip(cases, results, strict=True)]
    bounds = {case["case"]["size"]: result["air"] for case, result in both if case["study"] == _BOUND}
    return [
        (
            case["name"],
            case["figure"],
            number(result, "air"),
            number(result, "air") / bounds.get(case["case"].get("size"), float("nan")),
            *(number(result, name) for name in _COLUMNS),
            _REPORTED_KB.get(case["name"], float("nan")),
            number(result, "angle_deg"),
            number(result, "steps"),
        )
        for case, result in both
    ]


def _plot(settings: Settings, cases: Sequence[Case], results: Sequence[Result]) -> Figure:
    read = [(case["name"], result) for case, result in zip(cases, results, strict=True) if "own_mi_map" in result]
    figure = Figure(figsize=(16, 9), layout="constrained")
    wide = _SHOWN // 2
    grid, shown = figure.add_gridspec(3, wide, height_ratios=(1, 1, 2)), read[:_SHOWN]
    maps = [figure.add_subplot(grid[number // wide, number % wide]) for number in range(_SHOWN)]
    top = max((float(np.nanmax(result["own_mi_map"])) for _, result in shown), default=1.0)
    for axis, (name, result) in zip(maps, shown, strict=False):
        axis.imshow(result["own_mi_map"], vmin=0, vmax=top, cmap="viridis")
        axis.set_title(f"{name}: {result['own_mi']:.2f} bit", fontsize="medium")
    for axis in maps:
        axis.set_axis_off()
    angles, bars = figure.add_subplot(grid[2, : wide // 2]), figure.add_subplot(grid[2, wide // 2 :])
    for name, result in read:
        if len(result["angles"]):
            angles.plot(*result["angles"].T, ".-", markersize=3, label=name)
    angles.axhline(settings.device.geometry.pipe_angle_deg, color="k", linestyle="--", label="true")
    angles.set_xlabel("step")
    angles.set_ylabel("pipe angle, degrees")
    angles.legend(fontsize="small")
    places = np.arange(len(read))
    for offset, key, what in ((-0.2, "own_mi_claimed_kB", "own-MI"), (0.2, "air_kB", "AIR")):
        bars.bar(places + offset, [result[key] for _, result in read], 0.4, label=what)
    bars.set_xticks(places, [name for name, _ in read], rotation=60, fontsize="small")
    bars.set_ylabel("kB a page")
    bars.legend()
    return figure


STUDY = Study(
    title="the paper's figures and tables, and what Lightpage reads of the same light",
    source="figures 2 to 5, supplement",
    cases=_cases,
    measure=_measure,
    header=(
        "piece",
        "of",
        "AIR",
        "over the bound",
        "own-MI",
        "kB by AIR",
        "kB by own-MI",
        "user bytes",
        "paper kB",
        "angle",
        "steps",
    ),
    rows=_rows,
    plot=_plot,
    trains=True,
    parts=True,
    changeable=True,
)
