"""A recalibration in its own process ends as one in this process does, or changes nothing and leaves nothing behind."""

from __future__ import annotations

import os
import re
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import accumulate
from pathlib import Path

import numpy as np
import pytest

from lightpage.errors import BundleError, CallerLeft, RecalibrationRefusedError, WorkerError
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.tracking import NoTracker
from lightpage.runtime.recalibration.recalibration import RecalibrationOutcome, recalibrate
from lightpage.runtime.recalibration.separate_process import Job, WorkFolder, recalibrate_apart
from lightpage.runtime.recalibration.worker import LOWEST, NICENESS, ROOM, work, yield_more
from tests.clock import HandClock
from tests.runtime import toy
from tests.runtime.recalibration.toy_worker import known, quiet, shuffled

SOUND = "tests.runtime.recalibration.toy_worker"
SILENT = (
    "import os, signal\n"
    "from lightpage.helper_process import parent_link\n"
    "from lightpage.runtime.recalibration.worker import telling\n"
    "telling(parent_link())(f'fit in {os.getpid()}', 0.5)\n"
    "signal.pause()\n"
)
REFUSING = (
    "import json, pathlib, sys\n"
    "told = {'kind': 'RecalibrationRefusedError', 'subject': 'fit', 'got': 'worse', 'expected': 'better'}\n"
    "(pathlib.Path(sys.argv[1]) / 'result.json').write_text(json.dumps({'error': told}))\n"
)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where temporary folders are made; nothing may be left in it."""
    made = tmp_path / "temporary"
    made.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(made))
    return made


@dataclass
class Apart:
    decoder: Decoder
    out: Path
    worker: str = SOUND
    check: Callable[[], None] = lambda: None
    steps: list[tuple[str, float]] = field(default_factory=list)
    clock: HandClock = field(default_factory=HandClock)

    def run(self, limit_s: float = 60.0) -> RecalibrationOutcome:
        tracker, told = NoTracker(self.decoder), lambda *step: self.steps.append(step)
        job = (self.decoder, tracker, known(), self.out, "toy-1+r1", told, self.check, limit_s)
        return recalibrate_apart(*job, worker=self.worker, clock=self.clock.now)

    @property
    def process(self) -> int:
        """The worker's; 0 before it has told of a step."""
        found = [re.search(r"fit in (\d+)", name) for name, _ in self.steps]
        return next((int(each[1]) for each in found if each), 0)


def gone(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


def test_it_finds_what_this_process_finds_and_leaves_the_bundle_alone(
    decoder: Decoder, tmp_path: Path, folder: Path
) -> None:
    apart = Apart(decoder, tmp_path / "apart.zip")
    found = apart.run()
    here = recalibrate(decoder, known(), tmp_path / "here.zip", "toy-1+r1", toy.fit_references, quiet)
    same = {"path": here.path, "seconds": here.seconds, "air_before": here.air_before, "air_after": here.air_after}
    assert replace(found, **same) == here  # type: ignore[arg-type]
    assert (found.air_before, found.air_after) == pytest.approx((here.air_before, here.air_after), abs=1e-3)
    assert Decoder.load(found.path, threads=1).version == "toy-1+r1"
    assert apart.process not in (0, os.getpid())
    (niceness,) = [int(name.split()[-1]) for name, _ in apart.steps if name.startswith("fit in")]
    assert niceness == min(19, os.nice(0) + NICENESS)
    assert [share for _, share in apart.steps] == sorted(share for _, share in apart.steps)
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize(
    ("worker", "limit_s", "error", "told"),
    [
        (REFUSING, 60.0, RecalibrationRefusedError, "fit: got worse"),
        ("import os; os.kill(os.getpid(), 9)", 60.0, WorkerError, "status -9"),
        ("print(1, flush=True); 1 / 0", 60.0, WorkerError, "status 1"),
        (SILENT, 60.0, WorkerError, "60 s"),
        (SILENT, 1000.0, CallerLeft, None),
    ],
    ids=["refused", "killed", "broken", "too long", "nobody waits"],
)
def test_a_process_that_comes_to_no_good_end_changes_nothing(
    worker: str,
    limit_s: float,
    error: type[BaseException],
    told: str | None,
    decoder: Decoder,
    tmp_path: Path,
    tmp_path_factory: pytest.TempPathFactory,
    folder: Path,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    modules = tmp_path_factory.mktemp("modules")
    (modules / "bad_worker.py").write_text(worker)
    monkeypatch.setenv("PYTHONPATH", str(modules), prepend=os.pathsep)
    apart, times = Apart(decoder, tmp_path / "new.zip", "bad_worker"), accumulate([0.9 * limit_s, 0.2 * limit_s])
    (tmp_path / ".new.zip-half").mkdir()  # as far as the worker had come

    def check() -> None:
        if apart.process and error is CallerLeft:
            raise CallerLeft
        apart.clock.advance(next(times) if apart.process else 0.0)

    apart.check = check
    with pytest.raises(error, match=told):
        apart.run(limit_s)
    assert not apart.process or gone(apart.process)
    assert bool(apart.process) == (worker == SILENT)
    assert ["ZeroDivisionError" in record.getMessage() for record in caplog.records] == [True] * ("1 / 0" in worker)
    assert list(tmp_path.iterdir()) == [folder]
    assert list(folder.iterdir()) == []


def test_the_worker_leaves_its_refusal_in_its_folder(decoder: Decoder, tmp_path: Path) -> None:
    steps: list[tuple[str, float]] = []
    pages, folder = shuffled(known(), slice(None)), WorkFolder(tmp_path)
    job = Job(bundle=decoder.bundle.path, out=tmp_path / "n.zip", version="toy-1+r1", memory=None)
    folder.write_task(decoder.bundle, pages, job)
    work(folder, lambda *step: steps.append(step), toy.fit_references)
    with pytest.raises(RecalibrationRefusedError, match="re-fitted geometry"):
        folder.read_result()
    assert not (tmp_path / "n.zip").exists()
    assert steps[0] == ("measure the model in service", 0.0)


def test_it_ends_with_its_parent() -> None:
    worker = (
        "import threading\n"
        "from lightpage.helper_process import parent_link\n"
        "from lightpage.runtime.recalibration.worker import end_with_parent\n"
        "link = parent_link()\n"
        "end_with_parent(link)\n"
        "link.sendall(b'1')\n"
        "threading.Event().wait()\n"
    )
    own, other = socket.socketpair()
    with other, subprocess.Popen([sys.executable, "-c", worker], stdin=other) as child:
        assert own.recv(1)
        assert child.poll() is None
        own.close()  # as when its parent is killed
        assert child.wait(60) != 0


def test_all_that_is_known_of_the_pages_comes_over(decoder: Decoder, tmp_path: Path) -> None:
    mask = np.zeros(toy.PAGE, bool)
    job = Job(bundle=tmp_path / "b.zip", out=tmp_path / "n.zip", version="v", memory=None)
    for pages in (replace(known(), pilot_mask=mask, image_px=(1.5, -2.0)), replace(known(), references=None)):
        (folder := WorkFolder(tmp_path / str(pages.image_px))).path.mkdir()
        folder.write_task(decoder.bundle, pages, job)
        bundle, found, read = folder.read_task()
        assert (read, bundle.path, bundle.manifest.version) == (job, tmp_path / "b.zip", decoder.version)
        assert (found.levels, found.image_px) == (16, pages.image_px)
        for name in ("references", "pilot_mask"):
            assert (getattr(found, name) is None) == (getattr(pages, name) is None)
        assert found.pilot_mask is None or not found.pilot_mask.any()
        assert np.array_equal(found.pairs[1].in_phase, pages.pairs[1].in_phase)
        assert np.array_equal(found.symbols, pages.symbols)


def test_errors_keep_their_class_and_words(tmp_path: Path) -> None:
    folder = WorkFolder(tmp_path)
    assert folder.read_result() is None
    for error in (WorkerError("a", "b", "c"), BundleError("bundle", 3, 4)):
        folder.write_result(error)
        with pytest.raises(type(error)) as caught:
            folder.read_result()
        assert str(caught.value) == str(error)


@pytest.mark.parametrize(("shares", "looks"), [([ROOM], 1), ([0.1, ROOM - 0.01, ROOM + 0.01, 0.1], 3), ([1.0], 1)])
def test_it_yields_all_once_reads_leave_it_room(
    shares: list[float], looks: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, begun, asked = HandClock(0.0), 0.0, list[tuple[int, int, int]]()
    monkeypatch.setattr(os, "setpriority", lambda *how: asked.append(how))
    worked = iter([each for share in accumulate(shares, initial=begun) for each in (share, share)][1:])
    yield_more(clock=clock, worked=lambda: next(worked, 0.0)).join()
    assert asked == [(os.PRIO_PROCESS, os.getpid(), LOWEST)]
    assert clock.now() == looks
