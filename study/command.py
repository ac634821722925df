"""The command `lightpage study`: one question about the device or its decoders, answered in a table and a picture."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import click
import torch

from lightpage.cli.options import JSON, FiniteRange
from lightpage.cli.paths import OutputFolder
from lightpage.cli.progress_bar import percent_bar
from lightpage.device.profile import load_profile
from lightpage.errors import InvalidInputError
from lightpage.metrics.provenance import write_figures
from lightpage.run_files import BEGUN
from lightpage.study import STUDIES
from lightpage.study.lights import Lights
from lightpage.study.study import RESULTS, Settings, left, measured, written
from lightpage.train.data.torch_engine import torch_device
from lightpage.train.fitting.memory import keep_freed_memory
from lightpage.train.runs import begin, sole_writer

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
@click.option("--left", "tell_left", is_flag=True, help="Name the cases that are left to measure, in order, and end.")
@click.option(
    "--minutes",
    type=FiniteRange(min=0.1, max=10_000),
    help="Stop after so long as after Ctrl-C: what is measured is kept, what is trained goes on from its last pass.",
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
        load_profile(_FULL if full else profile_name or "bench"), quick, seed, share, channels, Lights(str(device))
    )
    results_folder = out / _RESULTS
    cases = chosen.chosen(settings, only, results_folder)  # before anything is written
    if tell_left:
        click.echo("\n".join(left(chosen, settings, results_folder)) or "none")
        return
    context.with_resource(sole_writer(out))
    if results_folder.exists() and not results_folder.is_dir():
        raise InvalidInputError(f"study {out}: {_RESULTS}", "a file", "a folder, or another --out")
    if results_folder.exists() and not (out / BEGUN).exists():
        expected = f"a study that says in {BEGUN} what it was begun with, or another --out"
        raise InvalidInputError(f"study {out}", "results of unknown origin", expected)
    begin(out, {"study": name, "results": RESULTS, **settings.key()})
    results_folder.mkdir(exist_ok=True)
    results = []
    with percent_bar() as progress, _stopped_after(minutes):
        for number, case in enumerate(cases):
            results.append(
                measured(
                    chosen,
                    settings,
                    case,
                    results_folder,
                    lambda what, share, n=number, c=case: progress(f"{c['name']}: {what}", (n + share) / len(cases)),  # type: ignore[misc]
                )
            )
    how = "" if share == 1 else f"; {share:.0%} of the authors' steps"
    how += "" if channels == Settings.channels else f"; network of {channels}/{2 * channels} channels"
    table = written(out, chosen, settings, cases, results, how)
    figures = {
        "study": name,
        **settings.key(),
        "header": list(chosen.header),
        "rows": [list(row) for row in chosen.rows(cases, results)],
    }
    for path in (out / "study.json", json_path):
        write_figures(path, figures, settings=settings.key(), results=results_folder)
    click.echo(f"{table}\n\nwritten to {out}")


@contextmanager
def _stopped_after(minutes: float | None) -> Iterator[None]:
    """Interrupt the program as Ctrl-C does, where the work within takes longer."""
    if minutes is None:
        yield
        return
    alarm = threading.Timer(60 * minutes, signal.raise_signal, [signal.SIGINT])
    alarm.daemon = True
    alarm.start()
    try:
        yield
    finally:
        alarm.cancel()
