"""Studies: cases that are measured one by one and kept, then a table and a picture of all of them."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from lightpage.device.profile import Profile
from lightpage.device.state import Device
from lightpage.errors import InvalidInputError
from lightpage.files import replace_file, replace_text, write_json
from lightpage.metrics.provenance import PROVENANCE, provenance
from lightpage.progress import Progress
from lightpage.study.lights import Lights
from lightpage.train.published.training import PublishedChoices
from lightpage.train.runs import load_arrays, save_arrays

RESULTS = 5
"""Raised when results that were kept by an earlier version do not go together with those of this one."""
Case = Mapping[str, Any]
"""Values that are varied, by name; `name` tells it from the others and names its files."""
Result = Mapping[str, Any]
"""Values that were measured, by name: numbers, texts, and arrays."""
Row = Sequence[object]


@dataclass(frozen=True)
class Settings:
    """Settings that every study is given.

    Attributes:
        profile: the nominal device.
        quick: whether to measure as few and as small cases as show that it works; their figures say little.
        seed: seed of everything random.
        share: share of the authors' steps that networks are trained for.
        channels: channels of the published network at sample pitch, twice as many below; the authors' if left out.
        changes: changes of the realistic device, `TABLE.KEY=VALUE`.
        lights: light that cases share; where they compute does not set them apart.
    """

    profile: Profile
    quick: bool = False
    seed: int = 0
    share: float = 1.0
    channels: int = PublishedChoices.channels[0]
    changes: tuple[str, ...] = ()
    lights: Lights = field(default_factory=Lights, compare=False)

    def key(self) -> dict[str, Any]:
        """The settings as JSON keeps them."""
        kept = {name: getattr(self, name) for name in ("quick", "seed", "share", "channels")}
        changes = {"changes": list(self.changes)} if self.changes else {}  # folders of before know none
        return {"profile": self.profile.to_toml(), **kept, **changes}

    @property
    def device(self) -> Device:
        """The realistic device with the changes.

        Raises:
            ProfileError: see `Device.with_settings`.
        """
        return Device().with_settings(list(self.changes))


@dataclass(frozen=True)
class Study:
    """A question asked of the device.

    Attributes:
        title: the question, in a line.
        source: figure or table of the published study that it repeats, or where it goes beyond.
        cases: cases that are measured, some only `by_name`.
        measure: function from a case to its result; its work may be kept in the folder given, so that it can be gone on
            with.
        header: header of the table.
        rows: function from cases and results to rows of the table.
        plot: a picture of all results.
        trains: whether it trains published decoders, which takes hours without a GPU at full scale.
        parts: whether table and picture can be made of some of the cases, with those that say `needed`.
        changeable: whether its device may be another than the realistic one.
    """

    title: str
    source: str
    cases: Callable[[Settings], list[Case]]
    measure: Callable[[Settings, Case, Path, Progress], Result]
    header: Row
    rows: Callable[[Sequence[Case], Sequence[Result]], list[Row]]
    plot: Callable[[Settings, Sequence[Case], Sequence[Result]], Figure]
    trains: bool = False
    parts: bool = False
    changeable: bool = False

    def chosen(self, settings: Settings, only: Sequence[str], folder: Path) -> list[Case]:
        """Return the cases whose names begin with one of some words, are needed, or have results in the folder.

        Without a word all are chosen but those that are measured `by_name` alone.

        Raises:
            InvalidInputError: no name begins so.
        """
        cases = self.cases(settings)
        for word in only:
            if not any(str(case["name"]).startswith(word) for case in cases):
                raise InvalidInputError(f"--only {word}", "no such case", _names(cases))
        there = {path.stem for path in folder.glob("*.json")}
        return [
            case
            for case in cases
            if (not only and not case.get("by_name"))
            or case.get("needed")
            or case["name"] in there
            or (only and str(case["name"]).startswith(tuple(only)))
        ]


def measured(study: Study, settings: Settings, case: Case, folder: Path, progress: Progress) -> Result:
    """The result of a case, kept in `folder` under the case's name; measured if it is not there.

    Raises:
        InvalidInputError: a result that is there and damaged.
    """
    path = folder / f"{case['name']}.json"
    if path.exists():
        return load_result(path)
    work = folder / str(case["name"])
    work.mkdir(parents=True, exist_ok=True)
    result = study.measure(settings, case, work, progress)
    _save(path, result, provenance(settings=settings.key(), case=dict(case)).to_json())
    return result


def left(cases: Sequence[Case], folder: Path) -> list[str]:
    """Names of the cases without a result in the folder, in order."""
    return [str(case["name"]) for case in cases if not (folder / f"{case['name']}.json").exists()]


def written(
    folder: Path, study: Study, settings: Settings, cases: Sequence[Case], results: Sequence[Result], how: str = ""
) -> str:
    """Write the table and the picture of results, and return the table; `how` is told beside the title."""
    table = aligned(study.header, study.rows(cases, results))
    figure, picture = study.plot(settings, cases, results), "picture of the study"
    replace_file(folder / "figure.png", lambda file: figure.savefig(file, format="png", dpi=110), picture)
    replace_text(folder / "table.txt", f"{study.title} ({study.source}){how}\n\n{table}\n", "table of the study")
    return table


def _names(cases: Sequence[Case]) -> str:
    """Beginnings of the cases' names, without values and seeds."""
    return "one of " + ", ".join(dict.fromkeys(re.sub(r"=.*|-\d+$", "", str(case["name"])) for case in cases))


def aligned(header: Row, rows: Sequence[Row]) -> str:
    """A table as text, numbers to four digits, columns lined up."""
    texts = [[_text(value) for value in row] for row in (header, *rows)]
    widths = [max(map(len, column)) for column in zip(*texts, strict=True)]
    lines = ["  ".join(text.rjust(width) for text, width in zip(row, widths, strict=True)) for row in texts]
    return "\n".join(lines)


def _text(value: object) -> str:
    if isinstance(value, float):
        return "-" if np.isnan(value) else f"{value:.4g}"
    return str(value)


def _save(path: Path, result: Result, made_by: dict[str, Any]) -> None:
    """Keep arrays beside the rest, and first: a result that is there is whole."""
    arrays = {name: value for name, value in result.items() if isinstance(value, np.ndarray)}
    rest = {name: value for name, value in result.items() if name not in arrays}
    save_arrays(_arrays(path), arrays)
    kept = {PROVENANCE: made_by, "values": rest, "arrays": list(arrays)}
    write_json(path, kept)


def load_result(path: Path) -> Result:
    """Read the result of a case.

    Raises:
        InvalidInputError: it is missing or damaged.
    """
    try:
        kept = json.loads(path.read_text("utf-8"))
        arrays = load_arrays(_arrays(path))
        values = {name: np.nan if value is None else value for name, value in kept["values"].items()}
        return values | {name: arrays[name] for name in kept["arrays"]}
    except (OSError, ValueError, TypeError, KeyError, InvalidInputError) as error:
        expected = "a whole one with its arrays; where it is removed, the case is measured again"
        raise InvalidInputError(f"result {path}", error, expected) from None


def _arrays(path: Path) -> Path:
    return path.with_suffix(".npz")
