"""An object in another process answers, fails, tells and ends as if it were here; whatever ends, nothing is left."""

import os
import resource
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from lightpage.errors import LostShotError, Reason, WorkerError
from lightpage.helper_process import Helper, HelperProcess
from tests.processes import children, runs
from tests.waiting import eventually

ROOT = Path(__file__).resolve().parents[2]
TARGET = f"{__name__}:Echo"
WAIT_S = 60.0


@pytest.fixture(autouse=True)
def importable(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let processes import these tests, wherever they are started."""
    monkeypatch.setenv("PYTHONPATH", str(ROOT))


class Echo(Helper):
    idle_s = 0.01
    farewell_s = WAIT_S

    left, was_idle = Path(os.devnull), False

    def idle(self) -> None:
        self.was_idle = True

    def close(self) -> None:
        self.left.touch()

    def same(self, what: object) -> object:
        return what

    def has_been_idle(self) -> bool:
        return self.was_idle

    def steps(self, count: int, progress: Callable[[str, int], None]) -> str:
        for step in range(count):
            progress("step", step)
        return "done"

    def lose(self) -> None:
        raise LostShotError("camera", "nothing", "a frame", Reason.CAMERA_GONE, recalibration_due=True)

    def break_down(self) -> None:
        raise ZeroDivisionError

    def wait(self) -> None:
        threading.Event().wait()

    def say_half(self, steps: int, said: Path, progress: Callable[[int], None]) -> None:
        for step in range(steps):
            progress(step)
        os.write(sys.stdin.fileno(), (1 << 10).to_bytes(4) + b"x")
        said.touch()
        self.wait()

    def leave_room_for(self, size: int) -> None:
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + size, resource.RLIM_INFINITY))

    def tell_of_its_end(self, path: Path) -> None:
        self.left = path


class Hasty(Echo):
    farewell_s = 0.0


@pytest.fixture
def process() -> Iterator[HelperProcess]:
    made = HelperProcess(TARGET, subject="echo")
    yield made
    made.end()


def test_answers_errors_and_progress_come_as_they_were_meant(process: HelperProcess) -> None:
    picture = np.arange(3_000_000, dtype=np.uint16).reshape(1000, -1)
    assert (process.ask("same", picture, timeout_s=WAIT_S) == picture).all()
    with pytest.raises(LostShotError, match=r"^camera: .*\(CAMERA_GONE\)$") as lost:
        process.ask("lose", timeout_s=WAIT_S)
    assert (lost.value.reason, lost.value.recalibration_due) == (Reason.CAMERA_GONE, True)
    told: list[tuple[str, int]] = []
    process.send("steps", 3, progress=lambda *words: told.append(words))
    assert process.poll(WAIT_S)
    assert (process.answer(), told) == ("done", [("step", 0), ("step", 1), ("step", 2)])
    assert eventually(lambda: process.ask("has_been_idle", timeout_s=WAIT_S))


def test_one_that_is_killed_is_named_with_its_signal(process: HelperProcess) -> None:
    process.send("wait")
    os.kill(process.pid, signal.SIGKILL)
    assert process.poll(WAIT_S)
    for act in (process.answer, lambda: process.ask("same", 1, timeout_s=WAIT_S)):
        with pytest.raises(WorkerError, match="signal 9"):
            act()
    assert process.ended()


def test_one_that_breaks_hangs_or_cannot_be_started_is_told_apart(
    process: HelperProcess, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(WorkerError, match=r"no answer .*0\.05"):
        process.ask("wait", timeout_s=0.05)
    for _ in range(2):  # it is of no more use
        with pytest.raises(WorkerError, match=r"^echo:"):
            process.ask("same", 1, timeout_s=WAIT_S)
        process.end()
    stopped = HelperProcess(TARGET, subject="echo")
    os.kill(stopped.pid, signal.SIGSTOP)
    with pytest.raises(WorkerError, match=r"no answer .*0\.05"):
        stopped.ask("same", bytes(1 << 22), timeout_s=0.05)
    stopped.end()
    broken = HelperProcess(TARGET, subject="echo")
    with pytest.raises(WorkerError, match="with status 1"):
        broken.ask("break_down", timeout_s=WAIT_S)
    broken.end()
    assert "ZeroDivisionError" in capfd.readouterr().err
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    with pytest.raises(WorkerError, match="can be started"):
        HelperProcess(TARGET, subject="echo")


def test_what_comes_at_once_or_by_half_holds_nobody_longer_than_the_limit(
    process: HelperProcess, tmp_path: Path
) -> None:
    told: list[int] = []
    process.send("say_half", 100, tmp_path / "said", progress=told.append)
    eventually((tmp_path / "said").exists)
    heard: list[int] = []
    polling = threading.Thread(
        target=lambda: [heard.append(process.poll(0.0) or len(told)) for _ in range(200)], daemon=True
    )
    polling.start()
    polling.join(WAIT_S)
    assert (polling.is_alive(), heard[0] <= 1, told) == (False, True, [*range(100)])


def test_any_thread_may_end_it_while_another_waits_for_its_answer(process: HelperProcess) -> None:
    found: list[str] = []

    def asked() -> None:
        with pytest.raises(WorkerError) as error:
            process.ask("wait", timeout_s=WAIT_S)
        found.append(str(error.value))

    waiting = threading.Thread(target=asked)
    waiting.start()
    process.end()
    waiting.join(WAIT_S)
    assert "signal 9" in found[0]


def test_a_process_that_cannot_take_in_what_it_hears_ends(tmp_path: Path) -> None:
    with (tmp_path / "log").open("w+b") as log:
        process = HelperProcess(TARGET, subject="echo", log=log)
        process.ask("leave_room_for", 1 << 26, timeout_s=WAIT_S)
        with pytest.raises(WorkerError, match="with status 1"):
            process.ask("same", np.zeros(1 << 28, np.uint8), timeout_s=WAIT_S)
        process.end()
    assert "MemoryError" in (tmp_path / "log").read_text()


PARENT = """
import sys
from pathlib import Path
from lightpage.helper_process import HelperProcess
process = HelperProcess(sys.argv[1], subject="echo")
process.ask("tell_of_its_end", Path(sys.argv[2]), timeout_s=60)
process.send(*sys.argv[3:])
print(process.pid, flush=True)
sys.stdin.read()
"""


@pytest.mark.parametrize(("target", "busy"), [(TARGET, ("has_been_idle",)), (f"{__name__}:Hasty", ("wait",))])
def test_it_ends_with_a_parent_that_is_killed_and_closes_what_it_has_where_there_is_time(
    target: str, busy: tuple[str], tmp_path: Path
) -> None:
    left = tmp_path / "left"
    command = [sys.executable, "-c", PARENT, target, str(left), *busy]
    with subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as parent:
        try:
            assert parent.stdout is not None
            child = int(parent.stdout.readline())
            assert children(parent.pid, target) == [child]
        finally:
            parent.kill()
    eventually(lambda: not runs(child))
    assert left.exists() == (target == TARGET)
