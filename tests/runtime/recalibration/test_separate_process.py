"""A recalibration in its own process ends as one in this process does, or changes nothing and leaves nothing behind."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lightpage.device.state import Device
from lightpage.errors import BundleError, LightpageError, RecalibrationRefusedError
from runtime.acquisition.simulator import SimulatorSource
from runtime.bundle.shipped import DEFAULT, bundle_path
from runtime.decoding.decoder import Decoder
from runtime.decoding.image_tracker import tracker_for
from runtime.decoding.tracking import NoTracker
from runtime.demo.demo import drifted
from runtime.errors import CallerLeft, WorkerError
from runtime.recalibration.known_pages import KnownPages
from runtime.recalibration.outcome import RecalibrationOutcome
from runtime.recalibration.recalibration import recalibrate
from runtime.recalibration.separate_process import recalibrate_apart
from runtime.recalibration.work import Job, WorkFolder
from runtime.recalibration.worker import LOWEST, NICENESS
from runtime.service.caller import Caller
from runtime.service.dataplane import DataPlane
from runtime.service.recalibrator import Recalibrator
from runtime.service.registry import ModelRegistry
from tests.runtime import toy
from tests.runtime.recalibration.test_recalibration import known, quiet, shuffled

Steps = list[tuple[str, float]]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where temporary folders are made; nothing may be left in it."""
    made = tmp_path / "temporary"
    made.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(made))
    return made


def apart(
    decoder: Decoder,
    out: Path,
    kind: str = "sound",
    pages: KnownPages | None = None,
    check: Callable[[], None] = lambda: None,
    limit_s: float = 60.0,
    steps: Steps | None = None,
) -> RecalibrationOutcome:
    def progress(name: str, fraction: float) -> None:
        if steps is not None:
            steps.append((name, fraction))

    worker = ("-m", "tests.runtime.recalibration.toy_worker", kind)
    tracker = NoTracker(decoder)
    return recalibrate_apart(
        decoder, tracker, pages or known(), out, "toy-1+r1", progress, check, limit_s, worker=worker
    )


def test_it_finds_what_this_process_finds_and_leaves_the_bundle_alone(
    decoder: Decoder, tmp_path: Path, folder: Path
) -> None:
    steps: Steps = []
    found = apart(decoder, tmp_path / "apart.zip", steps=steps)
    here = recalibrate(decoder, known(), tmp_path / "here.zip", "toy-1+r1", toy.fit_references, quiet)
    same = {"path": here.path, "seconds": here.seconds, "air_before": here.air_before, "air_after": here.air_after}
    assert replace(found, **same) == here  # type: ignore[arg-type]
    assert (found.air_before, found.air_after) == pytest.approx((here.air_before, here.air_after), abs=1e-3)
    assert Decoder.load(found.path, threads=1).version == "toy-1+r1"
    (name,) = [name for name, _ in steps if name.startswith("fit in")]
    process, niceness = map(int, re.findall(r"\d+", name))
    assert process != os.getpid()
    assert niceness == min(19, os.nice(0) + NICENESS)
    assert [share for _, share in steps] == sorted(share for _, share in steps)
    assert list(folder.iterdir()) == []


def test_its_refusal_is_this_process_refusal(decoder: Decoder, tmp_path: Path, folder: Path) -> None:
    pages = shuffled(known(), slice(None))
    with pytest.raises(RecalibrationRefusedError) as here:
        recalibrate(decoder, pages, tmp_path / "here.zip", "toy-1+r1", toy.fit_references, quiet)
    with pytest.raises(RecalibrationRefusedError) as there:
        apart(decoder, tmp_path / "apart.zip", pages=pages)
    assert str(there.value) == str(here.value)
    assert list(tmp_path.iterdir()) == [folder]
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize(
    ("kind", "limit_s", "match"),
    [("killed", 60, "status -9"), ("bug", 60, "status 1"), ("slow", 4, "no end within 4 s"), ("slow", 0, "within 0 s")],
)
def test_a_process_that_comes_to_no_end_changes_nothing(
    kind: str, limit_s: float, match: str, decoder: Decoder, tmp_path: Path, folder: Path
) -> None:
    with pytest.raises(WorkerError, match=match):
        apart(decoder, tmp_path / "new.zip", kind, limit_s=limit_s)
    assert list(tmp_path.iterdir()) == [folder]
    assert list(folder.iterdir()) == []


def gone(process: int, seconds: float = 10.0) -> bool:
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        try:
            state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
        except OSError:
            return True
        if state == "Z":
            return True
        time.sleep(0.05)
    return False


def test_it_ends_with_its_caller(decoder: Decoder, tmp_path: Path, folder: Path) -> None:
    steps: Steps = []

    def leave() -> None:
        if any(name.startswith("fit in") for name, _ in steps):
            raise CallerLeft

    with pytest.raises(CallerLeft):
        apart(decoder, tmp_path / "new.zip", "slow", check=leave, steps=steps)
    assert gone(int(re.findall(r"\d+", steps[-1][0])[0]))
    assert list(tmp_path.iterdir()) == [folder]
    assert list(folder.iterdir()) == []


def test_it_ends_when_its_parent_is_killed(decoder: Decoder, tmp_path: Path) -> None:
    folder = WorkFolder(tmp_path)
    job = Job(bundle=tmp_path, out=tmp_path / "n.zip", version="toy-1+r1", threads=1, memory=None)
    folder.write_task(decoder.bundle, known(), job)
    worker = f"[sys.executable, '-m', 'tests.runtime.recalibration.toy_worker', 'slow', {str(tmp_path)!r}]"
    script = (
        "import subprocess, sys, time\n"
        f"child = subprocess.Popen({worker}, stdin=subprocess.PIPE, stdout=subprocess.PIPE)\n"
        "print(child.pid, flush=True)\n"
        "time.sleep(60)\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE)
    assert parent.stdout is not None
    try:
        child = int(parent.stdout.readline())
    finally:
        parent.kill()
        parent.wait(10)
        parent.stdout.close()
    assert gone(child)


def test_what_is_there_already_is_never_overwritten(decoder: Decoder, tmp_path: Path) -> None:
    (tmp_path / "new.zip").write_text("mine")
    with pytest.raises(BundleError, match="something that exists"):
        apart(decoder, tmp_path / "new.zip")
    assert (tmp_path / "new.zip").read_text() == "mine"


def test_all_that_is_known_of_the_pages_comes_over(decoder: Decoder, tmp_path: Path) -> None:
    folder, mask = WorkFolder(tmp_path), np.zeros(toy.PAGE, bool)
    job = Job(bundle=tmp_path / "b.zip", out=tmp_path / "n.zip", version="v", threads=2, memory=None)
    pages = replace(known(), pilot_mask=mask, image_px=(1.5, -2.0))
    folder.write_task(decoder.bundle, pages, job)
    bundle, found, read = folder.read_task()
    assert read == job
    assert (bundle.path, bundle.manifest.version) == (tmp_path / "b.zip", decoder.version)
    assert (found.levels, found.image_px) == (16, (1.5, -2.0))
    assert found.references is not None
    assert found.pilot_mask is not None
    assert not found.pilot_mask.any()
    for one, other in zip(found.pairs, pages.pairs, strict=True):
        assert np.array_equal(one.in_phase, other.in_phase)
        assert one.quadrature.dtype == other.quadrature.dtype
    assert np.array_equal(found.symbols, pages.symbols)


def test_errors_keep_their_class_and_words(tmp_path: Path) -> None:
    folder = WorkFolder(tmp_path)
    assert folder.read_result() is None
    for error in (WorkerError("a", "b", "c"), BundleError("bundle", 3, 4)):
        folder.write_error(error)
        with pytest.raises(LightpageError) as caught:
            folder.read_result()
        assert (type(caught.value), str(caught.value)) == (type(error), str(error))


def test_a_drifted_bench_device_is_recalibrated_by_the_service_beside_its_reads(folder: Path) -> None:
    """Takes its seconds: the real worker with the shipped bundle."""
    decoder = Decoder.load(bundle_path(DEFAULT), threads=1)
    source = SimulatorSource(decoder.bundle.profile, drifted(Device(), 0.3), levels=256)
    plane = DataPlane(ModelRegistry(decoder, tracker_for), source)
    plane.read_page(None, None, Caller())
    recalibrator = Recalibrator(plane)
    *_, outcome = recalibrator.from_source(2, [], Caller())
    assert isinstance(outcome, RecalibrationOutcome)
    assert outcome.air_after > outcome.air_before
    assert plane.registry.current.version == outcome.version
    assert plane.read_page(None, None, Caller()).answer.model_version == outcome.version
    recalibrator.close()
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize(("room", "niceness"), [(0.0, LOWEST), (2.0, NICENESS)])
def test_it_yields_all_once_reads_leave_it_room(room: float, niceness: int) -> None:
    """Tried in a process of its own: a priority cannot be raised again."""
    program = (
        "import os, time\n"
        "from runtime.recalibration import worker\n"
        "worker.yield_to_reads()\n"
        f"worker.yield_more({room}, 0.05).join(1.0)\n"
        "print(os.getpriority(os.PRIO_PROCESS, os.getpid()))\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True)
    assert int(done.stdout) == min(19, os.nice(0) + niceness)
