"""A command runs beside a simulated device, which ends with it."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from runtime.virtual_device.namespace import INSIDE

pytestmark = pytest.mark.own_network


def started(folder: Path, *command: str) -> subprocess.Popen[str]:
    argv = [
        sys.executable,
        "-m",
        "lightpage.cli.main",
        "virtual-device",
        "--out",
        str(folder / "device"),
        "--",
        *command,
    ]
    return subprocess.Popen(argv, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.fixture(autouse=True)
def inside(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(INSIDE, "1")  # the test is in a private network already


def test_its_status_is_that_of_the_command(tmp_path: Path) -> None:
    running = started(tmp_path, "sh", "-c", f"test -S {tmp_path}/device/modulator.sock && exit 7")
    out, err = running.communicate(timeout=60)
    assert running.returncode == 7
    assert out == ""
    assert "simulated device at camera:" in err


def test_a_command_that_is_not_there_is_named(tmp_path: Path) -> None:
    running = started(tmp_path, "no-such-command")
    _, err = running.communicate(timeout=60)
    assert running.returncode == 2
    assert "command no-such-command" in err
    assert "Traceback" not in err


def test_sigterm_ends_the_command_too(tmp_path: Path) -> None:
    mark = tmp_path / "mark"
    running = started(
        tmp_path, "sh", "-c", f"trap 'kill $!; echo ended > {mark}; exit' TERM; sleep 60 & echo ready; wait"
    )
    assert running.stdout is not None
    assert running.stdout.readline() == "ready\n"
    running.send_signal(signal.SIGTERM)
    running.communicate(timeout=60)
    assert running.returncode == 143
    for _ in range(100):
        if mark.exists():
            break
        time.sleep(0.05)
    assert mark.read_text() == "ended\n"
