"""Writes docs/results/index.md and its picture from the figures in analysis/results; collects newer ones if asked to.

    python -m analysis.results.page --from runs/bench-decoders

A figure that is missing leaves its row out, and the command says which. A comparison without a method
that is kept is not collected: it is not finished.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import click
from jinja2 import Environment, StrictUndefined

from analysis.comparison.decoders_figure import LABELS
from analysis.comparison.outcome import SETTLED_BITS
from analysis.results.measurements import (
    BOUND,
    COMPARISONS,
    DEMO,
    EVALUATION,
    IMAGE_SEARCH,
    KEPT,
    LEDGER,
    SPEED,
    TOLERANCES,
    WAVES,
    Figures,
    Measurement,
    collected,
    kept_measurements,
    methods,
    read_object,
    slim,
)
from analysis.results.picture import draw
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.device.profile import load_profile
from lightpage.device.state import Device
from lightpage.files import read_text, replace_text
from lightpage.study.study import aligned

_DATA_SET = ("angle_deg", "full_well_e", "exposure", "symbol_size_px")
"""Keys of a data set that tell its light."""

ROOT = Path(__file__).parents[2]
PAGE, PICTURE = ROOT / "docs" / "results" / "index.md", Path("images") / "decoders.png"
PICTURED = "sheared"
"""The comparison whose picture the page shows."""
TEMPLATE = "results.md.j2"
LEDGER_LABELS = {
    "bright": "bench, 4x4, 15,000 electrons, shipped",
    "32e waves": "bench, 4x4, 32 electrons, fitted waves",
    "32e": "bench, 4x4, 32 electrons, two passes",
    "full-size 4x4 waves": "full size, 4x4, 32 electrons, fitted waves",
    "full-size 4x4 fast": "full size, 4x4, 32 electrons, `fast`",
    "full-size 4x4 standard": "full size, 4x4, 32 electrons, `standard`",
    "full-size 4x4": "full size, 4x4, 32 electrons, two passes",
    "full-size 2x2": "full size, 2x2, 32 electrons, two passes",
}
"""Data sets of the ledger of user bytes, in the order of its table."""
SPEED_LABELS = {
    "fast": "`--preset fast`",
    "coherent": "one pass, coherent",
    "wave": "`--preset standard`",
    "refined": "`--preset accurate`",
    "ray 32/64": "published, ray localizer",
}
"""Decoders of the speed benchmark, in the order of its table."""
FULL_SIZE = "full-size"
"""Begins the names of comparisons on the profile `paper`; others are on `bench`."""


@dataclass(frozen=True)
class Results:
    """Results that a template asks for by name; those that are missing are noted.

    Attributes:
        measurements: measurements by name.
        missing: names that were asked for and are not there.
    """

    measurements: Mapping[str, Measurement]
    missing: list[str] = field(default_factory=list)

    def figures(self, name: str) -> Figures | None:
        """The figures of a measurement."""
        if name in self.measurements:
            return self.measurements[name].figures
        self._miss(name)
        return None

    def outcome(self, name: str, angle_deg: float, method: str) -> Figures | None:
        """The outcome of a comparison's method at a pipe angle, with its exposure."""
        for data_set in (self.figures(name) or {"data_sets": []})["data_sets"]:
            for outcome in data_set["outcomes"]:
                # the name of a method with several passes ends with their number
                if data_set["angle_deg"] == angle_deg and outcome["method"].removesuffix(" 1") == method:
                    return {**{key: data_set[key] for key in _DATA_SET}, **outcome}
        self._miss(f"{name}, {angle_deg:g} degree, {method}")
        return None

    def outcomes(self, name: str, angle_deg: float, *methods: str) -> list[Figures] | None:
        """The outcomes of several methods, None if one is missing."""
        found = [self.outcome(name, angle_deg, method) for method in methods]
        whole = [outcome for outcome in found if outcome is not None]
        return whole if len(whole) == len(methods) else None

    def seconds(self, profile: str, decoder: str) -> float | None:
        """Return the seconds of a page in the speed benchmark; None where the decoder was not timed."""
        name = f"{SPEED}{profile}"
        for timed in (self.figures(name) or {"decoders": []})["decoders"]:
            if timed["decoder"] == decoder:
                return float(timed["seconds"])
        self._miss(f"{name}, {decoder}")
        return None

    def bounds(self) -> list[Figures]:
        """Return the bounds of the light that are known."""
        return [of.figures for name, of in self.measurements.items() if name.startswith(BOUND)]

    def waves(self) -> list[tuple[Figures, Figures]]:
        """Return the figures of the fitted waves by light, the brightest first, each with the bound of its light."""
        known = [of.figures for name, of in self.measurements.items() if name.startswith(WAVES)]
        bounds = [self.bound_of(each["profile"], *(each[key] for key in _DATA_SET)) for each in known]
        pairs = [(each, light) for each, light in zip(known, bounds, strict=True) if light is not None]
        return sorted(pairs, key=lambda pair: -pair[1]["bits"])

    def bound(self, name: str, outcome: Figures) -> Figures | None:
        """Return the bound of a comparison's light, None where it is not known or the device has no defects."""
        profile = "paper" if name.startswith(FULL_SIZE) else "bench"
        return self.bound_of(profile, *(outcome[key] for key in _DATA_SET))

    def bound_of(self, profile: str, *data_set: float) -> Figures | None:
        """Return the bound of a device's light.

        Args:
            profile: name of the profile.
            data_set: values of `_DATA_SET`.
        """
        asked = [profile, *data_set]
        return next((of for of in self.bounds() if [of[key] for key in ("profile", *_DATA_SET)] == asked), None)

    def origins(self) -> list[tuple[tuple[str, str], list[str]]]:
        """Return the names of measurements by their commit, shortened, and their source."""
        found = defaultdict[tuple[str, str], list[str]](list)
        for name, measurement in self.measurements.items():
            of = measurement.provenance
            source = "notebook" if "notebook" in of.source else "output" if of.source else "complete"
            kind = {BOUND: "bounds", WAVES: "waves"}.get(name.partition("-")[0] + "-", name)
            found[of.commit[:7], source].append(kind)
        return [(origin, list(dict.fromkeys(names))) for origin, names in found.items()]

    def _miss(self, what: str) -> None:
        if what not in self.missing:
            self.missing.append(what)


def render(results: Results) -> str:
    """The page, Markdown."""
    environment = Environment(
        autoescape=False, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True
    )
    environment.filters |= {"digits": digits, "kilobytes": kilobytes, "thousands": thousands}
    source = Path(__file__).with_name(TEMPLATE).read_text("utf-8")
    return environment.from_string(source).render(
        results=results,
        device=Device(),
        symbols=symbols,
        learning_bits=SETTLED_BITS,
        LABELS=LABELS,
        LEDGER_LABELS=LEDGER_LABELS,
        SPEED_LABELS=SPEED_LABELS,
    )


def digits(value: float, count: int) -> str:
    """Format a value with so many digits behind the point."""
    return f"{value:.{count}f}"


def thousands(value: float) -> str:
    """A whole number with commas."""
    return f"{value:,.0f}"


def kilobytes(value: float) -> str:
    """Two digits behind the point of a small page, fewer of a large one."""
    return digits(value, 2 if value < 20 else 1 if value < 100 else 0)


def symbols(profile: str, size_px: int) -> str:
    """Return the number of symbols on a page of a profile whose symbols have this size, as text."""
    rows, columns = load_profile(profile).with_symbols_of(size_px).page_shape
    return f"{columns} x {rows} of {size_px}x{size_px}"


def name_of_light(prefix: str, figures: Figures) -> str:
    """Return the name under which the figures of a light are kept, a bound or those of the fitted waves."""
    angle, well, exposure, size = (f"{figures[key]:g}" for key in _DATA_SET)
    return f"{prefix}{figures['profile']}_{angle}deg_{well}e_{exposure}x_{size}px"


def with_table(page: str, figures: Figures) -> str:
    """Return the page of tolerances with the table of the kept figures in its last block of code."""
    *before, _, end = page.split("```\n")
    return "```\n".join([*before, aligned(figures["header"], figures["rows"]) + "\n", end])


@click.command()
@click.option(
    "--from",
    "comparisons",
    type=click.Path(exists=True, file_okay=False, path_type=Path),
    help="Collect the comparisons below this folder.",
)
@click.option(
    "--bound",
    "bounds",
    type=click.Path(path_type=Path),
    multiple=True,
    help="Collect a JSON of `analysis.comparison.bound`.",
)
@click.option(
    "--waves",
    type=click.Path(path_type=Path),
    multiple=True,
    help="Collect a JSON of `analysis.speed.waves`.",
)
@click.option("--evaluation", type=click.Path(path_type=Path), help="Collect the JSON of `lightpage evaluate`.")
@click.option("--demo", type=click.Path(path_type=Path), help="Collect the demo.json of `lightpage demo`.")
@click.option("--image-search", type=click.Path(path_type=Path), help="Collect the figures.json of the image search.")
@click.option("--ledger", type=click.Path(path_type=Path), help="Collect the ledger.json of the page code.")
@click.option(
    "--speed",
    "speeds",
    type=click.Path(path_type=Path),
    multiple=True,
    help="Collect a JSON of `analysis.speed.speed`.",
)
@click.option("--tolerances", type=click.Path(path_type=Path), help="Collect the study.json of that study.")
@click.option(
    "--kept",
    type=click.Path(exists=True, file_okay=False, path_type=Path),
    default=KEPT,
    show_default="analysis/results",
    help="Folder of the figures.",
)
@click.option("--out", type=OutputFile(), default=PAGE, show_default="docs/results/index.md", help="The page.")
def main(
    comparisons: Path | None,
    bounds: tuple[Path, ...],
    waves: tuple[Path, ...],
    evaluation: Path | None,
    demo: Path | None,
    image_search: Path | None,
    ledger: Path | None,
    speeds: tuple[Path, ...],
    tolerances: Path | None,
    kept: Path,
    out: Path,
) -> None:
    """Write docs/results/index.md, its picture, and the table of tolerances.md from the kept figures."""
    given = {EVALUATION: evaluation, DEMO: demo, IMAGE_SEARCH: image_search, LEDGER: ledger, TOLERANCES: tolerances}
    found = {name: path for name, path in given.items() if path is not None}
    for prefix, paths in ((BOUND, bounds), (WAVES, waves)):
        found |= {name_of_light(prefix, slim(prefix, read_object(path))): path for path in paths}
    found |= {f"{SPEED}{read_object(path).get('profile')}": path for path in speeds}
    if comparisons is not None:
        below = {name: comparisons / name / "figures.json" for name in COMPARISONS}
        found |= {name: path for name, path in below.items() if path.exists()}
        for name in [name for name in below if name not in found]:
            click.echo(f"not collected, no {below[name]}")
    before = kept_measurements(kept)
    for name, path in found.items():
        measurement = collected(name, path)
        lacking = methods(before[name]) - methods(measurement) if name in before else set()
        if lacking:  # a comparison writes its figures method by method
            click.echo(f"not collected, unfinished: {path} lacks {', '.join(sorted(lacking))}")
            continue
        if name == LEDGER and name in before:  # data sets that were not measured anew stay
            measurement = replace(measurement, figures={**before[name].figures, **measurement.figures})
        measurement.write(kept / f"{name}.json")
        click.echo(f"{name}: {measurement.provenance.time}, commit {measurement.provenance.commit[:7]}")
    results = Results(kept_measurements(kept))
    replace_text(out, render(results), "page")
    beside = out.with_name(f"{TOLERANCES}.md")
    if beside.exists() and (table := results.figures(TOLERANCES)):
        replace_text(beside, with_table(read_text(beside, f"page {beside}", "Markdown"), table), "page")
    if pictured := results.figures(PICTURED):
        (data_set,) = pictured["data_sets"]
        light = results.bound(PICTURED, data_set)
        draw(data_set, None if light is None else float(light["bits"]), out.absolute().parents[1] / PICTURE)
    for what in results.missing:
        click.echo(f"left out, no figures: {what}")
    click.echo(f"written to {out}")


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.results.page"))
