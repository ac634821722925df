"""Measured figures as `analysis/results` keeps them: what a benchmark wrote, without what the page never shows."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from lightpage.device.profile import parse_profile
from lightpage.errors import InvalidInputError
from lightpage.files import write_json
from lightpage.metrics.provenance import PROVENANCE, Provenance
from lightpage.study.knobs import KNOBS

Figures = dict[str, Any]

KEPT = Path(__file__).parent
COMPARISONS = (
    "sheared",
    "square",
    "dim",
    "small-symbols",
    "dim-small-symbols",
    "full-size",
    "full-size-small-symbols",
    "ideal",
)
"""Folders of `make bench-decoders`."""
EVALUATION, DEMO, IMAGE_SEARCH, LEDGER, TOLERANCES = "evaluation", "demo", "image-search", "ledger", "tolerances"
PAGE_CODE = "page-code"
SPEED = "speed-"
"""Before the name of a profile."""
BOUND = "bound-"
WAVES = "waves-"
"""Before the name of a data set, as `BOUND`."""


@dataclass(frozen=True)
class Measurement:
    """Figures with where they are from.

    Attributes:
        figures: under the names that the benchmark gave them.
        provenance: what measured them, or where they were copied from.
        note: remark that a reader must know, if any.
    """

    figures: Figures
    provenance: Provenance
    note: str = ""

    @classmethod
    def read(cls, path: Path) -> Measurement:
        """Read a file that `write` has written.

        Raises:
            InvalidInputError: another file.
        """
        kept = read_object(path)
        try:
            return cls(kept["figures"], Provenance.model_validate(kept[PROVENANCE]), kept.get("note", ""))
        except (KeyError, ValidationError) as error:
            raise InvalidInputError(f"figures {path}", error, "a file of analysis/results") from None

    def write(self, path: Path) -> None:
        """Write it as JSON."""
        note = {"note": self.note} if self.note else {}
        write_json(path, {PROVENANCE: self.provenance.to_json(), **note, "figures": self.figures})


def read_object(path: Path) -> Figures:
    """A JSON object.

    Raises:
        InvalidInputError: there is none, or something else.
    """
    try:
        found = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise InvalidInputError(f"figures {path}", error, "a benchmark's JSON") from None
    if not isinstance(found, dict):
        raise InvalidInputError(f"figures {path}", type(found).__name__, "a JSON object")
    return found


def kept_measurements(folder: Path = KEPT) -> dict[str, Measurement]:
    """Read all measurements of a folder, by name."""
    return {path.stem: Measurement.read(path) for path in sorted(folder.glob("*.json"))}


def collected(name: str, path: Path) -> Measurement:
    """Collect the figures that a benchmark has written, reduced to those that the pages need.

    Args:
        name: name of the measurement.
        path: path of its JSON.

    Raises:
        InvalidInputError: no JSON of that benchmark, or one that does not say where it is from.
    """
    figures = read_object(path)
    try:
        provenance = Provenance.model_validate(figures.pop(PROVENANCE, {}))
    except ValidationError as error:
        raise InvalidInputError(f"figures {path}", error, "a provenance") from None
    if provenance.unknown:
        raise InvalidInputError(f"figures {path}", f"no {', '.join(provenance.unknown)}", "all of the provenance")
    return Measurement(slim(name, figures), provenance)


def slim(name: str, figures: Figures) -> Figures:
    """The figures of a measurement without long curves, maps and lists of single pages.

    Raises:
        InvalidInputError: another benchmark's.
    """
    prefix = next((each for each in (BOUND, WAVES) if name.startswith(each)), name)
    take = comparison if name in COMPARISONS else _TAKE.get(prefix, speed)
    try:
        return take(figures)
    except (KeyError, TypeError, IndexError) as error:
        raise InvalidInputError(f"figures of {name}", repr(error), "the JSON of that benchmark, all of it") from None


def comparison(figures: Figures) -> Figures:
    """Drop the curves from the figures of `analysis.comparison.decoders`."""
    curves = {"training_curve", "validation_curve"}
    data_sets = [
        data_set | {"outcomes": [{key: of[key] for key in of if key not in curves} for of in data_set["outcomes"]]}
        for data_set in figures["data_sets"]
    ]
    return figures | {"data_sets": data_sets}


def methods(measurement: Measurement) -> set[str]:
    """Methods of a comparison with the angle that each was measured at; of another measurement none."""
    data_sets = measurement.figures.get("data_sets", [])
    return {
        f"{of['method']} at {data_set['angle_deg']:g} degree" for data_set in data_sets for of in data_set["outcomes"]
    }


def evaluation(figures: Figures) -> Figures:
    """Keep the numbers and texts of the figures of `lightpage evaluate`, but for its times: others work beside it."""
    return {"air_bits_per_symbol": figures["air_bits_per_symbol"]} | {
        key: value
        for key, value in figures.items()
        if isinstance(value, int | float | str) and not key.endswith("seconds_per_page")
    }


def demo(figures: Figures) -> Figures:
    """Keep the figures of `lightpage demo` that the pages need."""
    return {key: figures[key] for key in ("seed", "pages", "phases", "healing")}


def image_search(figures: Figures) -> Figures:
    """Count the outcomes of `analysis.tracking.image_search` over both operating points."""
    first = [row for part, of in figures.items() if part.endswith(": offsets") for row in of["rows"]]
    kinds = [kind for part, of in figures.items() if part.endswith(": wrong pages") for kind in of["kinds"].values()]
    return {
        "first_pages": len(first),
        "first_pages_found": sum(row.get("found", False) for row in first),
        "largest_offset_px": max((row["offset_px"] for row in first), default=None),
        "wrong_pages": sum(kind["pages"] for kind in kinds),
        "wrong_pages_given_out": sum(kind["given_out"] for kind in kinds),
    }


def ledger(figures: Figures) -> Figures:
    """Drop the margin of every page from the figures of `analysis.codec.ledger`, and data sets without pages."""
    return {name: {key: of[key] for key in of if key != "margins"} for name, of in figures.items() if of["pages"]}


def tolerances(figures: Figures) -> Figures:
    """Keep the table of `lightpage study tolerances`, which must have a row for each knob."""
    if len(figures["rows"]) <= len(KNOBS):
        raise KeyError(f"{1 + len(KNOBS)} rows")
    return {key: figures[key] for key in ("header", "rows", "seed")}


def speed(figures: Figures) -> Figures:
    """Keep the figures of `analysis.speed.speed` that the pages need."""
    return {key: figures[key] for key in ("profile", "threads", "repeats", "decoders")}


def _light(profile_toml: str, device: Figures) -> Figures:
    """Return the settings of a simulated device that its light depends on most."""
    profile = parse_profile(profile_toml, "figures")
    sensor = device["sensor"]
    return {
        "profile": profile.name,
        "angle_deg": device["geometry"]["pipe_angle_deg"],
        "full_well_e": sensor["full_well_e"],
        "exposure": sensor["exposure_relative"],
        "symbol_size_px": profile.page.symbol_size_px,
    }


def waves(figures: Figures) -> Figures:
    """Keep the figures of `analysis.speed.waves` by the number of steps, but for its times: others work beside it."""
    asked = figures["asked"]
    kept = ("steps", "air", "ece", "over_claim")
    rows = [{key: row[key] for key in kept} for row in figures["rows"]]
    return {**_light(asked["--profile"], asked["device"]), "pages": asked["--pages"], "rows": rows}


def bound(figures: Figures) -> Figures:
    """Keep the figures of `analysis.comparison.bound`, with what tells its data set."""
    asked = figures["asked"]
    return {
        **_light(asked["profile"], asked["device"]),
        "bits": figures["bits"],
        "standard_error": figures["standard_error"],
        "symbols": sum(map(len, figures["concentrations"])),
    }


_TAKE: dict[str, Callable[[Figures], Figures]] = {
    BOUND: bound,
    WAVES: waves,
    EVALUATION: evaluation,
    DEMO: demo,
    IMAGE_SEARCH: image_search,
    LEDGER: ledger,
    TOLERANCES: tolerances,
}
