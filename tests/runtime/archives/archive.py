"""Two toy recordings, and `lightpage bulk` on them within this process, by a clock that moves when somebody waits."""

import json
import shutil
from collections.abc import Callable, Generator, Iterable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from lightpage.cli.main import run as run_command
from lightpage.runtime.archives.run.shard import ShardRecord
from lightpage.runtime.archives.run.task import Outcome, Task
from lightpage.runtime.archives.workers.work import Worker
from lightpage.runtime.commands.archives import bulk as command
from tests.clock import HandClock
from tests.runtime import coded, toy

PAGES, RANGE = 7, 3


class Archive:
    """Recordings `a.h5` and `b.h5`, of seven pages each, and a bundle; `tasks` are those that the last run did."""

    def __init__(self, folder: Path, bundle: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.folder, self.out, self.json = folder, folder / "out", folder / "J.json"
        self.tasks: list[Task] = []
        self.before_each: Callable[[Task], None] = lambda task: None
        self.clock = HandClock(0.0)
        monkeypatch.setattr(command, "engine_of", lambda *_: InlineEngine(Watched(self)))
        monkeypatch.setattr(command, "CLOCK", self.clock)
        self.bundle = Path(shutil.copy(bundle, folder / "toy.zip"))
        for name, seed in (("a", 1), ("b", 2)):
            toy.write_toy_recording(folder / f"{name}.h5", toy.ToyDevice(seed=seed), 16, PAGES, seed)

    def run(self, operation: str, *options: str, asked: bool = True) -> tuple[int, dict[str, Any]]:
        """Exit status and figures; `tasks` has what was done."""
        self.tasks = []
        self.json.unlink(missing_ok=True)
        words = [operation, str(self.out), "--json", str(self.json)]
        if asked:
            words += ["--recordings", str(self.folder / "?.h5"), "--bundle", str(self.bundle)]
            words += [] if operation == "recalibrate" else ["--range-pages", str(RANGE)]
        status = run_command(command.bulk, [*words, *options])
        return status, json.loads(self.json.read_text()) if self.json.exists() else {}

    def firsts(self) -> list[tuple[str, int]]:
        """Recording and first page of each range that was done."""
        return [(task.recording.stem, task.pages[0]) for task in self.tasks]

    def records(self) -> dict[str, ShardRecord]:
        """All shards by name."""
        found = sorted(self.out.glob("shards/*/*.json"))
        return {f"{path.parent.name}/{path.stem}": ShardRecord.read(path.with_suffix("")) for path in found}

    def shows_a_file(self, spoilt: dict[int, coded.Spoil] | None = None) -> tuple[np.ndarray, tuple[str, ...]]:
        """Have its recordings show a file's pages, some spoilt; the pages, and options with which it is recovered."""
        bundle = coded.bundle(self.folder / "coded.zip")
        pages = coded.pages(bundle, self.folder)
        (self.folder / "pages.h5").rename(self.folder / "pages.sent")
        coded.recording(self.folder / "a.h5", pages[:8], spoilt)
        coded.recording(self.folder / "b.h5", pages[8:])
        return pages, ("--no-tracking", "--bundle", str(bundle))


class InlineEngine:
    """Has a worker of this process do one task after the other; an error that nobody foresaw ends it."""

    restarts, in_flight, workers_alive = 0, 0, 1

    def __init__(self, worker: Worker) -> None:
        self._worker = worker

    def run(self, tasks: Iterable[Task]) -> Generator[Outcome, None, None]:
        for task in tasks:
            self.in_flight = 1
            outcome = self._worker.work(task)
            self.in_flight = 0
            yield outcome


class Watched(Worker):
    """Tells an archive of its tasks."""

    def __init__(self, archive: Archive) -> None:
        super().__init__(1, toy.fit_references)
        self._archive = archive

    def work(self, task: Task) -> Outcome:
        self._archive.before_each(task)
        self._archive.tasks.append(task)
        return super().work(task)


@pytest.fixture
def archive(tmp_path: Path, toy_zip: Path, monkeypatch: pytest.MonkeyPatch) -> Archive:
    return Archive(tmp_path, toy_zip, monkeypatch)


def spoil_page(path: Path, page: int) -> None:
    """Make a page of a recording black."""
    with h5py.File(path, "r+") as file:
        file["in_phase"][page] = 0
