"""`lightpage report`: a training run, an evaluation, a recovery or a bulk run as one HTML page for people."""

from __future__ import annotations

from pathlib import Path

import click

from lightpage.cli.options import JSON
from lightpage.cli.paths import OutputFile
from lightpage.errors import InvalidInputError
from lightpage.files import replace_text, write_json
from lightpage.report import recovery_figures
from lightpage.report.contents.from_recovery import report_of_recovery
from lightpage.report.json_file import EXPECTED, JsonFile
from lightpage.report.page import render
from lightpage.run_files import DESCRIPTION, EVALUATE, RECOVER
from lightpage.runtime.archives.run.job import FILE as JOB


@click.command()
@click.argument("source", metavar="RUN_OR_JSON", type=click.Path(path_type=Path, exists=True))
@click.option("--out", required=True, type=OutputFile(), help="HTML file to write.")
@click.option(
    "--recording",
    type=click.Path(path_type=Path),
    help="Recording of the run; needed for the published decoders none, mode and ray.",
)
@JSON
def report(source: Path, out: Path, recording: Path | None, json_path: Path | None) -> None:
    """Show a training run, a bulk run or figures as one self-contained HTML page.

    RUN_OR_JSON is the folder of a finished training run, that of a bulk run, finished or not, or what `lightpage
    evaluate --json` or `lightpage recover --json` wrote.
    """
    if source.is_dir():
        title, summary, text = _of_bulk(source, recording) if (source / JOB).exists() else _of_run(source, recording)
    else:
        title, summary, text = _of_json(JsonFile.read(source), recording)
    replace_text(out, text, "report")
    write_json(json_path, {"report": str(out), "title": title, "summary": summary, "bytes": len(text.encode())})
    click.echo(f"{out}: {title}, {summary}, {len(text) / 1e6:.1f} MB")


def _of_bulk(folder: Path, recording: Path | None) -> tuple[str, str, str]:
    """Title, summary and page."""
    from lightpage.report import bulk_figures
    from lightpage.report.contents.from_bulk import report_of_bulk

    _no_recording(recording, "a bulk run")
    data = report_of_bulk(folder)
    return data.title, data.summary, render(bulk_figures.TEMPLATE, data, bulk_figures.shown)


def _of_run(folder: Path, recording: Path | None) -> tuple[str, str, str]:
    if not (folder / DESCRIPTION).exists():
        raise InvalidInputError(f"folder {folder}", f"no {DESCRIPTION}", "a finished training run, or a bulk run")
    from lightpage.report import decoder_page
    from lightpage.report.contents.from_run import report_of_run

    data = report_of_run(folder, recording)
    return data.title, data.summary, render(decoder_page.TEMPLATE, data, decoder_page.shown)


def _of_json(file: JsonFile, recording: Path | None) -> tuple[str, str, str]:
    if file.command not in (EVALUATE, RECOVER):
        raise InvalidInputError(f"{file.path}", file.found, EXPECTED)
    _no_recording(recording, file.found)
    if file.command == RECOVER:
        recovery = report_of_recovery(file)
        page = render(recovery_figures.TEMPLATE, recovery, recovery_figures.shown)
        return recovery.title, recovery.summary, page
    from lightpage.report import decoder_page
    from lightpage.report.contents.from_evaluation import report_of_evaluation

    data = report_of_evaluation(file)
    return data.title, data.summary, render(decoder_page.TEMPLATE, data, decoder_page.shown)


def _no_recording(recording: Path | None, source: str) -> None:
    if recording is not None:
        raise InvalidInputError("--recording", recording, f"none with {source}, which holds all that is shown")
