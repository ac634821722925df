"""A command runs beside a simulated device, which ends with it."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from lightpage.cli import main as cli_main
from lightpage.cli.main import EXIT_ERROR, lightpage
from lightpage.errors import InvalidInputError
from lightpage.virtual_device import command as virtual_device
from tests.lightpage.small import small_profile


def started(folder: Path, *command: str) -> subprocess.Popen[str]:
    (folder / "small.toml").write_text(small_profile().to_toml())
    argv = [sys.executable, "-m", "lightpage.cli.main", "virtual-device", "--profile", str(folder / "small.toml")]
    return subprocess.Popen(
        [*argv, "--out", str(folder / "device"), "--", *command],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.own_network
def test_its_status_is_that_of_the_command(tmp_path: Path) -> None:
    running = started(tmp_path, "sh", "-c", f"test -S {tmp_path}/device/modulator.sock && exit 7")
    out, err = running.communicate(timeout=300)
    assert (running.returncode, out) == (7, "")
    assert f"camera:{tmp_path}/device/device.toml" in err


@pytest.mark.own_network
def test_sigterm_ends_the_command_too(tmp_path: Path) -> None:
    mark = tmp_path / "mark"
    # `read` waits for an end of input that does not come.
    running = started(tmp_path, "sh", "-c", f"trap 'echo ended > {mark}; exit' TERM; echo ready; read nothing")
    assert running.stdout is not None
    assert running.stdout.readline() == "ready\n"
    running.send_signal(signal.SIGTERM)
    assert running.wait(300) == 143
    assert mark.read_text() == "ended\n"
    running.communicate()


def test_a_command_that_is_not_there_is_named() -> None:
    before = signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)
    with pytest.raises(InvalidInputError, match="no-such-command"):
        virtual_device.run_to_its_end(["no-such-command"])
    assert (signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)) == before


def test_a_folder_that_cannot_be_written_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(virtual_device, "go_on_inside", lambda name: pytest.fail("started"))
    assert cli_main.run(lightpage, ["virtual-device", "--out", "/proc/self", "--", "true"]) == EXIT_ERROR
    assert "error: --out /proc/self:" in capsys.readouterr().err
