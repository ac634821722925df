"""`lightpage lookup-table`: corrects a modulator's lookup table by what a calibration has found of its levels."""

from pathlib import Path

import click
import numpy as np

from lightpage.cli.options import JSON
from lightpage.cli.paths import OutputFile
from lightpage.errors import InvalidInputError
from lightpage.files import replace_text, write_json
from lightpage.page.levels import MAX_LEVELS, MIN_LEVELS
from lightpage.page.symbols import symbol_phases
from lightpage.progress import note
from lightpage.runtime.device.modulator.lookup_table import (
    GREYS,
    calibration_text,
    levels_text,
    most_levels,
    read_table,
)


@click.command("lookup-table")
@click.option("--calibration", type=click.Path(path_type=Path), help="Calibration of the device, C.toml.")
@click.option("--bundle", help="Bundle of the device, in place of its calibration.")
@click.option("--out", required=True, type=OutputFile(), help="The corrected table.")
@click.option("--levels", type=click.IntRange(MIN_LEVELS, MAX_LEVELS), help="Write one grey value for each level.")
@click.option(
    "--in-use",
    type=click.Path(path_type=Path),
    help="The table with which the known pages of so many --levels were shown; without, 256 grey values were one wave.",
)
@JSON
def lookup_table(
    calibration: Path | None,
    bundle: str | None,
    out: Path,
    levels: int | None,
    in_use: Path | None,
    json_path: Path | None,
) -> None:
    """Write a lookup table with which the modulator's levels are even.

    It has the phase of each grey value, for pages of different levels; with --levels, the grey value of each level.
    Where the stroke is a little short, the levels share what there is. Calibrate anew once it is in use.
    """
    if (calibration is None) == (bundle is None):
        got = "neither --calibration nor --bundle" if bundle is None else "both --calibration and --bundle"
        raise InvalidInputError("options", got, "one of them")
    if in_use is not None and levels is None:
        raise InvalidInputError("options", "--in-use without --levels", "the number of levels of the known pages")
    if calibration is not None:
        from lightpage.calibration.document import load_calibration

        subject, modulation = f"calibration file {calibration}", load_calibration(calibration).modulator
    else:
        from lightpage.runtime.model.bundle.bundle import Bundle
        from lightpage.runtime.model.bundle.shipped import bundle_path

        opened = Bundle.open(bundle_path(str(bundle)))
        subject, modulation = opened.subject, opened.modulation
    if modulation.is_nominal:
        raise InvalidInputError(subject, "even levels, or none fitted", "uneven ones: even ones need no table")
    count = GREYS if in_use is None else int(levels or 0)
    greys = np.arange(GREYS) if in_use is None else read_table(in_use, count).astype(np.int64)
    curve = dict(zip(greys.tolist(), modulation.phase(symbol_phases(np.arange(count), count)).tolist(), strict=True))
    most = most_levels(curve, f"modulator of {subject}")
    even = levels_text(curve, levels or most, f"modulator of {subject}")
    if levels is None and most < MAX_LEVELS:
        note(f"the table makes at most {most} levels even; more would share grey values")
    replace_text(out, calibration_text(curve) if levels is None else even, "lookup table")
    written = {"table": str(out), "of": subject, "levels": levels, "most_levels": most}
    write_json(json_path, {**written, "modulation": modulation.as_dict()})
