"""The command as a process among others: its streams, signals, help and completion."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest


def shell(script: str, folder: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run a script in which `lightpage` is the command."""
    told = f'lightpage() {{ "{sys.executable}" -m lightpage.cli.main "$@"; }}\n{script}'
    environment = {**os.environ, **variables}
    done = subprocess.run(
        ["bash", "-c", told], capture_output=True, text=True, cwd=folder, timeout=120, env=environment
    )
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr
    return done


@pytest.mark.parametrize(
    ("script", "status"),
    [
        ("lightpage --help | true; exit ${PIPESTATUS[0]}", 0),
        ("lightpage --help >&-", 0),
        ("lightpage --help 2>&-", 0),
        ("lightpage --help <&- >&- 2>&-", 0),
        ("lightpage --help > /dev/full", 2),
        ("lightpage report no-such-file --out P.html 2> /dev/full", 2),
        ("lightpage report no-such-file --out P.html 2>&-", 2),
    ],
)
def test_streams_that_are_closed_full_or_absent(script: str, status: int, tmp_path: Path) -> None:
    assert shell(script, tmp_path).returncode == status


def test_files_are_whole_when_the_process_began_without_streams(tmp_path: Path) -> None:
    assert shell("lightpage simulate --profile bench --pages 1 --out R.h5 <&- >&- 2>&-", tmp_path).returncode == 0
    assert shell("lightpage simulate --profile bench --pages 1 --out S.h5 2> /dev/full", tmp_path).returncode == 0
    one, other = ((tmp_path / name).read_bytes() for name in ("R.h5", "S.h5"))
    assert one[:8] == other[:8] == b"\x89HDF\r\n\x1a\n"


def test_an_encoding_that_lacks_a_letter_stops_nothing(tmp_path: Path) -> None:
    done = shell("lightpage evaluate --recording ä.h5 --bundle ß.zip", tmp_path, PYTHONIOENCODING="ascii")
    assert done.returncode == 2
    assert ".zip: got nothing" in done.stderr


WAITS = """
import sys, time
import click
from lightpage.cli import main

@click.command()
def waits() -> None:
    print("ready", flush=True)
    time.sleep(60)

sys.exit(main.run(waits, []))
"""


@pytest.mark.parametrize(
    ("number", "status"), [(signal.SIGHUP, 129), (signal.SIGTERM, 143), (signal.SIGINT, 130)], ids=lambda n: str(n)
)
def test_a_signal_ends_a_command_that_says_how_to_go_on(number: int, status: int) -> None:
    with subprocess.Popen([sys.executable, "-c", WAITS], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"ready\n"
        process.send_signal(number)
        _, told = process.communicate(timeout=30)
    assert (process.returncode, b"run the same command again" in told) == (status, True)


def test_a_hangup_that_is_ignored_stays_so() -> None:
    code = WAITS.replace("time.sleep(60)", "time.sleep(0.1)")
    ignored = lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN)  # noqa: E731
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, preexec_fn=ignored) as process:
        assert process.stdout is not None
        process.stdout.readline()
        process.send_signal(signal.SIGHUP)
        assert process.wait(30) == 0


HELP = """
import contextlib, io, sys
lacking = {"torch", "onnxruntime", "lightning", "ray", "onnx", "onnxscript", "jinja2", "tensorboard", "harvesters"}

class Lacking:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in lacking:
            raise ModuleNotFoundError(name, name=name)

sys.meta_path.insert(0, Lacking())
import click
from lightpage.cli.main import lightpage, run

def shown(words, command):
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        assert run(lightpage, [*words, "--help"]) == 0, words
    assert out.getvalue().startswith(f"Usage: lightpage {' '.join(words)}"), words
    print(" ".join(words))

for name in lightpage.list_commands(None):
    shown([name], None)
for group in ("models", "bulk"):
    command = lightpage.points[group].load() if group == "bulk" else None
    for name in command.commands if command else ("list", "upload", "activate", "forward", "pin", "unpin"):
        shown([group, name], None)
"""


def test_every_command_shows_its_help_without_extras_and_required_options() -> None:
    done = subprocess.run([sys.executable, "-c", HELP], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stderr) == (0, "")
    assert {"train", "calibrate", "export", "models list", "bulk recover"} <= set(done.stdout.splitlines())


@pytest.mark.parametrize("kind", ["bash", "zsh", "fish"])
def test_shells_complete_commands_and_options(kind: str, tmp_path: Path) -> None:
    script = shell("lightpage", tmp_path, _LIGHTPAGE_COMPLETE=f"{kind}_source").stdout
    assert f"_LIGHTPAGE_COMPLETE={kind}_complete" in script
    for words, place, found in (("lightpage sim", 1, "simulate"), ("lightpage bulk recover --ho", 3, "--holes")):
        asked = {"COMP_WORDS": words, "COMP_CWORD": str(place) if kind != "fish" else words.split()[-1]}
        assert found in shell("lightpage", tmp_path, _LIGHTPAGE_COMPLETE=f"{kind}_complete", **asked).stdout


def test_libraries_of_linear_algebra_do_not_spin_unless_they_are_told_to(tmp_path: Path) -> None:
    from lightpage.cli.main import THREADS

    code = (
        "import os; from lightpage.cli import main;"
        "main.run = lambda _: print(os.environ.get('OPENBLAS_NUM_THREADS')); main.main()"
    )
    for own, seen in (({}, THREADS["OPENBLAS_NUM_THREADS"]), ({"OMP_NUM_THREADS": "3"}, "None")):
        kept = {name: value for name, value in os.environ.items() if name not in (*THREADS, "OMP_NUM_THREADS")}
        done = subprocess.run([sys.executable, "-c", code], env=kept | own, capture_output=True, text=True, timeout=60)
        assert done.stdout == f"{seen}\n"


@pytest.mark.parametrize(
    "asked",
    [
        "evaluate --recording R.h5 --json {long}",
        "bulk decode {long} --recordings R.h5",
        "encode F --bundle bench --out {long}",
        "encode - --bundle bench --out P.h5 <&-",
    ],
)
def test_names_that_are_too_long_and_absent_streams_are_named(asked: str, tmp_path: Path) -> None:
    done = shell(f"lightpage {asked.format(long='n' * 300)}", tmp_path)
    assert done.returncode in (0, 2)
    assert done.stderr.startswith("lightpage: ") or done.returncode == 0
