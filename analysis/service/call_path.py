"""The files of the project that a call enters, in order of first entry: `python -m analysis.service.call_path decode`.

A call is made twice, and only the second one is traced: caches and connections are then made. What `lightpage serve`
does from the first byte of the request to the answer counts, and what it starts for that; the client does not. See
`analysis.service.entered` for what it is to enter a function. Files that only record what a call does are listed apart.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from fnmatch import fnmatch
from pathlib import Path

import click

from analysis.service.entered import Entry, Traced, tracing
from analysis.service.running import RunningService
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.metrics.provenance import write_figures
from lightpage.runtime.archives.run.ledger import Ledger
from lightpage.runtime.archives.run.question import of_recordings
from lightpage.runtime.archives.run.task import Choices, Operation
from lightpage.runtime.archives.workers.work import Worker
from lightpage.runtime.client.client import LightpageClient
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.bundle.shipped import DEFAULT, bundle_path

APART = {
    "*/logs.py": "log of pages",
    "*/call_log.py": "log of calls",
    "*/audit.py": "log of changes",
    "*/flight_recorder.py": "frames of lost pages, for people",
    "*/streams.py": "log, on its way to the terminal",
    "*/metrics.py": "metrics",
    "*/history.py": "figures of the last pages, for the console",
    "*/stages.py": "times of a page, for metrics, traces and the reply",
    "*/traces.py": "traces",
    "*/errors.py": "errors",
    "*/failures.py": "errors: what those of the system mean",
    "*/status.py": "errors as gRPC says them",
}
"""Files that only record or name what becomes of a call, by pattern, and what: without them a call that succeeds would
have the same answer but for the times in it."""

_KNOWN_PAGES = 2
"""Known pages of a recalibration, which holds back one more."""
_DRIFTED = "geometry.pipe_angle_deg=-0.61"
"""Setting of the device that is recalibrated: a re-fit that brings nothing would be refused."""
_CALL_S = 1800.0
_SHOWN = 4
"""Functions of a file that are printed."""

Entries = Sequence[Entry]


@dataclass(frozen=True)
class EnteredFile:
    """A file that a call enters.

    Attributes:
        number: number in order of first entry.
        file: path in the repository.
        entered_from: path of the file that entered it first; empty where none of the project did.
        calls: calls of its functions.
        functions: functions in order of first entry.
        apart: why it is listed apart; empty where it is on the way.
    """

    number: int
    file: str
    entered_from: str
    calls: int
    functions: tuple[str, ...]
    apart: str


def files_of(entries: Entries) -> list[EnteredFile]:
    """The files of functions that were entered, in order of first entry."""
    by_file: dict[str, list[Entry]] = {}
    for entry in entries:
        by_file.setdefault(entry.file, []).append(entry)
    return [
        EnteredFile(
            number,
            file,
            own[0].caller if own[0].caller != file else "",
            sum(entry.calls for entry in own),
            tuple(dict.fromkeys(entry.function for entry in own)),
            next((why for pattern, why in APART.items() if fnmatch(file, pattern)), ""),
        )
        for number, (file, own) in enumerate(by_file.items(), 1)
    ]


def served(
    bundle: Bundle,
    folder: Path,
    options: Sequence[str],
    call: Callable[[LightpageClient], object],
    undo: Callable[[LightpageClient], object] = lambda _: None,
) -> Entries:
    """The functions that a service, started with some options, enters while it answers a call for the second time.

    Args:
        bundle: bundle that it serves.
        folder: empty.
        options: options of `lightpage serve`.
        call: call of the client.
        undo: done after the first time.
    """
    traced = Traced(folder)
    own = ("--bundle", str(bundle.path), "--health-address", "off")
    with (
        RunningService(*own, *options, environment=traced.environment) as service,
        LightpageClient(service.target, _CALL_S) as client,
    ):
        call(client)
        undo(client)
        with traced.entered():
            call(client)
    return traced.entries()


def decode(bundle: Bundle, folder: Path) -> Entries:
    """The functions that the service enters to decode a pair of frames that a caller sends."""
    return served(bundle, folder, (), lambda client: client.frames.decode(bundle.golden.pair))


def read_page(bundle: Bundle, folder: Path) -> Entries:
    """The functions that the service enters to read a page of a recording, which is its source."""
    source = ("--source", f"recording:{_recorded(bundle, folder)}")
    return served(bundle, folder, source, lambda client: client.pages.read())


def recalibration(bundle: Bundle, folder: Path) -> Entries:
    """The functions that the service, and the process it starts, enter until a recalibrated model is in service."""
    options = ("--source", f"recording:{_recorded(bundle, folder, _DRIFTED)}", "--store", str(folder / "store"))
    return served(
        bundle,
        folder,
        options,
        lambda client: client.jobs.recalibrate(count=_KNOWN_PAGES),
        lambda client: client.models.roll_back(),
    )


def bulk_page(bundle: Bundle, folder: Path) -> Entries:
    """The functions that a worker of a bulk run enters to decode a range of one page, which it begins to track."""
    choices = Choices(operation=Operation.DECODE, range_pages=1)
    job = of_recordings(choices, [str(_recorded(bundle, folder))], str(bundle.path), None)
    worker = Worker(threads=1)
    with Ledger(folder / "run") as ledger:
        before, task, *_ = ledger.missing(job)
    worker.work(before)
    with tracing() as recorder:
        worker.work(task)
    return recorder.entries()


CALLS: dict[str, Callable[[Bundle, Path], Entries]] = {
    "decode": decode,
    "read-page": read_page,
    "recalibration": recalibration,
    "bulk-page": bulk_page,
}


def _recorded(bundle: Bundle, folder: Path, *settings: str) -> Path:
    """A recording of known pages of a simulated device of the bundle's profile, some of its numbers changed."""
    (profile := folder / "profile.toml").write_text(bundle.manifest.profile)
    command = [sys.executable, "-m", "lightpage.cli.main", "simulate", "--profile", str(profile)]
    out = folder / "recorded.h5"
    changed = [word for setting in settings for word in ("--set", setting)]
    told = ("--pages", str(_KNOWN_PAGES + 1), "--out", str(out))
    subprocess.run([*command, *told, *changed], check=True, capture_output=True)
    return out


def _room(file: str) -> str:
    """The folder of a file, of those in `lightpage.runtime` the room that they belong to."""
    depth = 3 if file.startswith("lightpage/runtime/") else 2
    return "/".join(Path(file).parent.parts[:depth])


def _show(files: Sequence[EnteredFile]) -> None:
    width = max(len(file.file) for file in files)
    numbers = {file.file: file.number for file in files}
    for apart in (False, True):
        shown = [file for file in files if bool(file.apart) is apart]
        for file in shown:
            more = f" and {rest} more" if (rest := len(file.functions) - _SHOWN) > 0 else ""
            functions = ", ".join(file.functions[:_SHOWN]) + more
            caller = numbers.get(file.entered_from, "-")
            click.echo(f"{file.number:>3} {caller:>4} {file.file:<{width}} {file.calls:>6}  {functions}")
        rooms = Counter(_room(file.file) for file in shown)
        told = ", ".join(f"{room} {count}" for room, count in rooms.most_common())
        click.echo(f"{len(shown)} files {'that only record' if apart else 'on the way'}: {told or 'none'}")


@click.command()
@click.argument("call", type=click.Choice(list(CALLS)))
@click.option("--bundle", default=DEFAULT, show_default=True, help="A bundle's path, or the name of a shipped one.")
@click.option("--json", "json_path", type=OutputFile(), help="Write the files to this file.")
def main(call: str, bundle: str, json_path: Path | None) -> None:
    """Print the files that a call enters: number, that of the file it is entered from, path, calls, functions."""
    with tempfile.TemporaryDirectory(prefix="lightpage-") as folder:
        files = files_of(CALLS[call](Bundle.open(bundle_path(bundle)), Path(folder)))
    _show(files)
    if json_path is not None:
        write_figures(json_path, {"call": call, "files": [asdict(file) for file in files]})


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.service.call_path"))
