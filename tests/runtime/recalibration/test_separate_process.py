"""A recalibration in its own process ends as one in this process does, or changes nothing and leaves nothing behind."""

import os
import re
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import accumulate
from pathlib import Path

import pytest

from lightpage.errors import CallerLeft, RecalibrationRefusedError, WorkerError
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.tracking import NoTracker
from lightpage.runtime.recalibration import worker
from lightpage.runtime.recalibration.recalibration import RecalibrationOutcome, recalibrate
from lightpage.runtime.recalibration.separate_process import recalibrate_apart
from lightpage.runtime.recalibration.worker import LOWEST, NICENESS, ROOM, yield_more
from tests.clock import HandClock
from tests.processes import runs
from tests.runtime import toy
from tests.runtime.recalibration.toy_worker import known, quiet

WORKERS = "tests.runtime.recalibration.toy_worker"


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
    worker: str = "Sound"
    check: Callable[[], None] = lambda: None
    steps: list[tuple[str, float]] = field(default_factory=list)
    clock: HandClock = field(default_factory=HandClock)

    def run(self, limit_s: float = 60.0) -> RecalibrationOutcome:
        tracker, told = NoTracker(self.decoder), lambda *step: self.steps.append(step)
        job = (self.decoder, tracker, known(), self.out, "toy-1+r1", told, self.check, limit_s)
        return recalibrate_apart(*job, worker=f"{WORKERS}:{self.worker}", clock=self.clock.now)

    @property
    def process(self) -> int:
        """The worker's; 0 before it has told of a step."""
        found = [re.search(r"fit in (\d+)", name) for name, _ in self.steps]
        return next((int(each[1]) for each in found if each), 0)


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
        ("Refusing", 60.0, RecalibrationRefusedError, "fit: got worse"),
        ("Broken", 60.0, WorkerError, "status 1"),
        ("Silent", 60.0, WorkerError, "60 s"),
        ("Silent", 1000.0, CallerLeft, None),
    ],
)
def test_a_process_that_comes_to_no_good_end_changes_nothing(
    worker: str,
    limit_s: float,
    error: type[BaseException],
    told: str | None,
    decoder: Decoder,
    tmp_path: Path,
    folder: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    apart, times = Apart(decoder, tmp_path / "new.zip", worker), accumulate([0.9 * limit_s, 0.2 * limit_s])
    (tmp_path / ".new.zip-half").mkdir()  # as far as the worker had come

    def check() -> None:
        if apart.process and error is CallerLeft:
            raise CallerLeft
        apart.clock.advance(next(times) if apart.process else 0.0)

    apart.check = check
    with pytest.raises(error, match=told):
        apart.run(limit_s)
    assert not apart.process or not runs(apart.process)
    assert bool(apart.process) == (worker == "Silent")
    assert ["ZeroDivisionError" in record.getMessage() for record in caplog.records] == [True] * (worker == "Broken")
    assert list(tmp_path.iterdir()) == [folder]
    assert list(folder.iterdir()) == []


def test_it_takes_no_more_steps_than_the_service(toy_zip: Path, tmp_path: Path) -> None:
    limited = Decoder(Bundle.open(toy_zip), 1, steps=2)
    with pytest.raises(RecalibrationRefusedError, match="steps: got 2"):
        Apart(limited, tmp_path / "new.zip", "Limited").run()


@pytest.mark.parametrize(("shares", "looks"), [([ROOM], 1), ([0.1, ROOM - 0.01, ROOM + 0.01, 0.1], 3), ([1.0], 1)])
def test_it_yields_all_once_reads_leave_it_room(
    shares: list[float], looks: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, begun, asked = HandClock(0.0), 0.0, list[tuple[int, int, int]]()
    sessions = list[int]()
    monkeypatch.setattr(os, "setpriority", lambda *how: asked.append(how))
    monkeypatch.setattr(worker, "lower_session", sessions.append)  # not that of the tests
    worked = iter([each for share in accumulate(shares, initial=begun) for each in (share, share)][1:])
    yield_more(clock=clock, worked=lambda: next(worked, 0.0)).join()
    assert asked == [(os.PRIO_PROCESS, os.getpid(), LOWEST)]
    assert sessions == [LOWEST]
    assert clock.now() == looks
