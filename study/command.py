"""The command `lightpage study`: one question about the device or its decoders, answered in a table and a picture."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click
import torch

from lightpage.cli.options import JSON, FiniteRange
from lightpage.cli.paths import OutputFolder
from lightpage.cli.progress_bar import percent_bar
from lightpage.device.profile import load_profile
from lightpage.errors import InvalidInputError, MissingResultsError
from lightpage.metrics.provenance import digest, write_figures
from lightpage.progress import Progress
from lightpage.run_files import BEGUN
from lightpage.study import STUDIES
from lightpage.study.lights import Lights
from lightpage.study.study import RESULTS, Case, Settings, Study, left, load_result, measured, written
from lightpage.train.data.torch_engine import torch_device
from lightpage.train.fitting.memory import keep_freed_memory
from lightpage.train.runs import begin, check_begun, sole_writer

_FULL = "paper"
_RESULTS = "results"


@click.command(epilog="\n\n".join(f"{name}: {study.title} ({study.source})" for name, study in STUDIES.items()))
@click.argument("name", type=click.Choice(list(STUDIES)))
@click.option("--out", required=True, type=OutputFolder(), help="Folder of the study; gone on with if it is there.")
@click.option("--profile", "profile_name", help="Shipped profile or TOML file.  [default: bench]")
@click.option("--quick", is_flag=True, help="Few and small cases, to see that it works.")
@click.option(
    "--full", is_flag=True, help=f"Study at full scale, profile {_FULL}; studies that train need a GPU there."
)
@click.option(
    "--share",
    type=FiniteRange(min=0.001, max=1),
    default=1.0,
    show_default=True,
    help="Share of the authors' training steps, where a study trains; 1 takes hours for each case.",
)
@click.option(
    "--channels",
    type=click.IntRange(4, 256),
    default=Settings.channels,
    show_default=True,
    help="Channels of the published network at sample pitch; half as many train in a quarter of the time.",
)
@click.option(
    "--only",
    multiple=True,
    metavar="WORD",
    help="Cases whose names begin so, of a study of many; others can follow in the same OUT.",
)
@click.option(
    "--set", "changes", multiple=True, metavar="TABLE.KEY=VALUE", help="Change one number of the simulated device."
)
@click.option("--left", "tell_left", is_flag=True, help="Name the cases that are left to measure, in order, and end.")
@click.option(
    "--minutes",
    type=FiniteRange(min=0.1, max=10_000),
    help="Stop after so long, with status 75: what is measured is kept, what is trained goes on from its last pass.",
)
@click.option(
    "--compute",
    metavar="cpu|cuda[:N]",
    help="Processor that makes light and trains networks.  [default: cuda where there is a GPU]",
)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@JSON
def study(
    name: str,
    out: Path,
    profile_name: str | None,
    quick: bool,
    full: bool,
    share: float,
    channels: int,
    only: tuple[str, ...],
    changes: tuple[str, ...],
    tell_left: bool,
    minutes: float | None,
    compute: str | None,
    seed: int,
    json_path: Path | None,
) -> None:
    """Measure the cases of study NAME, write OUT/table.txt, OUT/figure.png and OUT/study.json, and print the table."""
    keep_freed_memory()
    if full and profile_name is not None:
        raise InvalidInputError("--full", f"--profile {profile_name} beside it", "one of them")
    chosen = STUDIES[name]
    device = torch_device(compute or ("cuda" if torch.cuda.is_available() else "cpu"))
    if full and chosen.trains and device.type != "cuda" and not tell_left:
        raise InvalidInputError(f"study {name} --full", "no CUDA device", "one: it trains networks at full scale")
    if compute and not chosen.trains:
        raise InvalidInputError(f"study {name} --compute", f"{compute} of a study that trains nothing", "no --compute")
    if changes and not chosen.changeable:
        able = ", ".join(name for name, study in STUDIES.items() if study.changeable)
        raise InvalidInputError(f"study {name} --set", " ".join(changes), f"no --set, or one of {able}")
    if share < 1 and not chosen.trains:
        raise InvalidInputError(f"study {name} --share", f"{share:g} of a study that trains nothing", "no --share")
    if channels != Settings.channels and (quick or not chosen.trains):
        got = f"{channels} {'with --quick' if chosen.trains else 'of a study that trains nothing'}"
        raise InvalidInputError(f"study {name} --channels", got, "no --channels")
    if only and not chosen.parts:
        raise InvalidInputError(f"study {name} --only", " ".join(only), "no --only: its picture needs all of its cases")
    context = click.get_current_context()
    context.meta["lightpage.resume"] = "run the same command again; it goes on where it was"
    settings = Settings(
        load_profile(_FULL if full else profile_name or "bench"),
        quick,
        seed,
        share,
        channels,
        changes,
        Lights(str(device)),
    )
    begun = {"study": name, "results": RESULTS, **settings.key()}
    results_folder = out / _RESULTS
    cases = chosen.chosen(settings, only, results_folder)  # before anything is written
    if tell_left:
        check_begun(out, begun)
        click.echo("\n".join(left(cases, results_folder)) or "none")
        return
    context.with_resource(sole_writer(out))
    if results_folder.exists() and not results_folder.is_dir():
        raise InvalidInputError(f"study {out}: {_RESULTS}", "a file", "a folder, or another --out")
    if results_folder.exists() and not (out / BEGUN).exists():
        expected = f"a study that says in {BEGUN} what it was begun with, or another --out"
        raise InvalidInputError(f"study {out}", "results of unknown origin", expected)
    begin(out, begun)
    results_folder.mkdir(exist_ok=True)
    try:
        with percent_bar() as progress, _stopped_after(minutes, f"study {name}"):
            for number, case in enumerate(cases):
                measured(chosen, settings, case, results_folder, _of_case(progress, case, number, len(cases)))
    finally:
        lacking = left(cases, results_folder)
        done = [case for case in cases if case["name"] not in lacking]
        if done and (chosen.parts or not lacking):
            _write(out, chosen, begun, settings, done, json_path)


def _of_case(progress: Progress, case: Case, number: int, count: int) -> Progress:
    """Return the progress of one case of so many."""
    return lambda what, share: progress(f"{case['name']}: {what}", (number + share) / count)


def _write(
    out: Path,
    chosen: Study,
    begun: dict[str, Any],
    settings: Settings,
    cases: Sequence[Case],
    json_path: Path | None,
) -> None:
    """Write table, picture and figures of the cases that are measured, and print the table."""
    results = [load_result(out / _RESULTS / f"{case['name']}.json") for case in cases]
    share, channels = settings.share, settings.channels
    how = "" if share == 1 else f"; {share:.0%} of the authors' steps"
    how += "" if channels == Settings.channels else f"; network of {channels}/{2 * channels} channels"
    how += "".join(f"; {change}" for change in settings.changes)
    table = written(out, chosen, settings, cases, results, how)
    rows = [list(row) for row in chosen.rows(cases, results)]
    figures = {"study": begun["study"], **settings.key(), "header": list(chosen.header), "rows": rows}
    kept = {path.name: digest(path) for path in sorted((out / _RESULTS).iterdir()) if path.is_file()}
    for path in (out / "study.json", json_path):
        write_figures(path, figures, settings=settings.key(), results=kept)
    click.echo(f"{table}\n\nwritten to {out}")


@contextmanager
def _stopped_after(minutes: float | None, subject: str) -> Iterator[None]:
    """Interrupt the work within where it takes longer.

    Raises:
        MissingResultsError: it took longer.
    """
    if minutes is None:
        yield
        return
    over = threading.Event()

    def stop() -> None:
        over.set()
        signal.raise_signal(signal.SIGINT)

    alarm = threading.Timer(60 * minutes, stop)
    alarm.daemon = True
    try:
        alarm.start()
        yield
    except (KeyboardInterrupt, click.Abort):
        if over.is_set():
            got = f"{minutes:g} minutes over"
            raise MissingResultsError(subject, got, "the same command again: it goes on where it was") from None
        raise
    finally:
        alarm.cancel()
