"""`lightpage report`: a training run or an evaluation as one HTML page for people."""

from __future__ import annotations

from pathlib import Path

import click

from analysis.report.from_evaluation import report_of_evaluation
from analysis.report.from_run import report_of_run
from analysis.report.page import render
from lightpage.cli.paths import OutputFile
from lightpage.errors import InvalidInputError
from lightpage.files import replace_text


@click.command()
@click.argument("source", metavar="RUN_OR_EVALUATION", type=click.Path(path_type=Path, exists=True))
@click.option("--out", required=True, type=OutputFile(), help="Where the page goes, HTML.")
@click.option(
    "--recording",
    type=click.Path(path_type=Path),
    help="Recording of the run; needed for the published decoders none, mode and ray.",
)
def report(source: Path, out: Path, recording: Path | None) -> None:
    """Show a finished training run, or the JSON of `lightpage evaluate`, as one self-contained HTML page."""
    if source.is_dir():
        data = report_of_run(source, recording)
    elif recording is not None:
        expected = "none with an evaluation, whose frames come from its bundle"
        raise InvalidInputError("--recording", recording, expected)
    else:
        data = report_of_evaluation(source)
    text = render(data)
    replace_text(out, text, "report")
    click.echo(f"{out}: {data.title}, AIR {data.measures.air_bits_per_symbol:.3f} bit/symbol, {len(text) / 1e6:.1f} MB")
