"""`lightpage report`: a training run, an evaluation or a recovery as one HTML page for people."""

from __future__ import annotations

from pathlib import Path

import click

from analysis.report.data import ReportData
from analysis.report.from_evaluation import report_of_evaluation
from analysis.report.from_recovery import RecoveryData, report_of_recovery
from analysis.report.from_run import report_of_run
from analysis.report.json_file import EVALUATE, EXPECTED, RECOVER, JsonFile
from analysis.report.page import render
from lightpage.cli.paths import OutputFile
from lightpage.errors import InvalidInputError
from lightpage.files import replace_text


@click.command()
@click.argument("source", metavar="RUN_OR_JSON", type=click.Path(path_type=Path, exists=True))
@click.option("--out", required=True, type=OutputFile(), help="Where the page goes, HTML.")
@click.option(
    "--recording",
    type=click.Path(path_type=Path),
    help="Recording of the run; needed for the published decoders none, mode and ray.",
)
def report(source: Path, out: Path, recording: Path | None) -> None:
    """Show a training run or figures as one self-contained HTML page.

    RUN_OR_JSON is the folder of a finished training run, or what `lightpage evaluate --json` or `lightpage recover
    --json` wrote.
    """
    data = report_of_run(source, recording) if source.is_dir() else _report_of_json(JsonFile.read(source), recording)
    text = render(data)
    replace_text(out, text, "report")
    click.echo(f"{out}: {data.title}, {data.summary}, {len(text) / 1e6:.1f} MB")


def _report_of_json(file: JsonFile, recording: Path | None) -> ReportData | RecoveryData:
    if file.command not in (EVALUATE, RECOVER):
        raise InvalidInputError(f"{file.path}", file.found, EXPECTED)
    if recording is not None:
        expected = f"none with {file.found}, which holds all that is shown"
        raise InvalidInputError("--recording", recording, expected)
    return report_of_evaluation(file) if file.command == EVALUATE else report_of_recovery(file)
