"""The command as a process among others: its streams, signals, help, completion, progress and lack of resources."""

import errno
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
import tqdm.std

from lightpage.cli import progress_bar
from lightpage.cli.main import EXIT_ERROR, HELP_KEY, lightpage, run
from lightpage.errors import RecordingError, SurroundingsError
from lightpage.failures import os_failure, understood
from tests.clock import HandClock
from tests.lightpage.small import small_profile


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
        ("lightpage --help <&- >&- 2>&-", 0),
        ("lightpage --help > /dev/full", 75),
        ("lightpage nonsense 2> /dev/full", 2),
    ],
)
def test_streams_that_are_closed_full_or_absent(script: str, status: int, tmp_path: Path) -> None:
    assert shell(script, tmp_path).returncode == status


def test_a_file_is_whole_when_the_process_began_without_streams(tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(small_profile().to_toml())
    script = "lightpage simulate --profile small.toml --pages 1 --out R.h5 <&- >&- 2>&-"
    assert shell(script, tmp_path).returncode == 0
    assert (tmp_path / "R.h5").read_bytes()[:8] == b"\x89HDF\r\n\x1a\n"


@pytest.mark.parametrize("encoding", ["utf-8:strict", "ascii:strict"])
def test_what_an_encoding_cannot_say_is_escaped(encoding: str) -> None:
    code = (
        "import sys, click; from lightpage.cli import main;"
        "main.lightpage = click.Command('c', callback=lambda: print(sys.argv[1]));"
        "main.run = lambda command: command.main([], standalone_mode=False) or 0; main.main()"
    )
    there = os.environ | {"PYTHONIOENCODING": encoding}
    name = os.fsdecode(b"a\xff.h5")
    done = subprocess.run([sys.executable, "-c", code, name], env=there, capture_output=True, timeout=60)
    assert (done.returncode, done.stdout) == (0, b"a\\udcff.h5\n")


@pytest.mark.parametrize(
    ("number", "ignored", "status"),
    [(signal.SIGTERM, False, 143), (signal.SIGHUP, False, 129), (signal.SIGHUP, True, 0)],
)
def test_sigterm_and_a_hangup_end_a_command_unless_they_are_ignored(
    number: signal.Signals, ignored: bool, status: int
) -> None:
    @click.command()
    def called() -> None:
        os.kill(os.getpid(), number)

    handler = signal.SIG_IGN if ignored else signal.SIG_DFL
    before = signal.signal(number, handler)
    try:
        assert run(called, []) == status
        assert signal.getsignal(number) == handler
    finally:
        signal.signal(number, before)


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


COMPLETED = """
import sys
from click.shell_completion import ShellComplete
from lightpage.cli.main import COMPLETE, lightpage
complete = ShellComplete(lightpage, {}, "lightpage", COMPLETE)
commands = [item.value for item in complete.get_completions([], "")]
assert {"simulate", "train"} <= set(commands)
print(len([name for name in sys.modules if name.startswith("lightpage.runtime")]))
for name in ("train", "export", "evaluate", "serve"):
    assert complete.get_completions([name], "-"), name
for words in (["decode", "--out"], ["evaluate", "--bundle"], ["import", "--in-phase"], ["simulate", "--profile"]):
    assert any(item.type == "file" for item in complete.get_completions(words, "")), words
print("--holes" in [item.value for item in complete.get_completions(["bulk", "recover"], "--ho")])
print([name for name in ("torch", "onnxruntime", "h5py") if hasattr(sys.modules.get(name), "__file__")])
"""


def test_shells_complete_commands_and_options_and_import_nothing_heavy(tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, "-c", COMPLETED], capture_output=True, text=True, timeout=120)
    assert done.stdout.splitlines() == ["0", "True", "[]"], done.stderr
    for name in ("bash", "zsh", "fish"):
        made = shell("lightpage", tmp_path, _LIGHTPAGE_COMPLETE=f"{name}_source").stdout
        assert f"_LIGHTPAGE_COMPLETE={name}_complete" in made


def parameters() -> Iterator[tuple[str, click.Parameter]]:
    """Every parameter of every command, with the command's name."""
    context = click.Context(lightpage)
    context.meta[HELP_KEY] = True
    for name in lightpage.list_commands(context):
        command = lightpage.get_command(context, name)
        for each in (command, *getattr(command, "commands", {}).values()):
            assert each is not None
            yield from ((each.name or name, param) for param in each.params)


def test_options_say_alike_what_their_values_are_and_what_reports_has_json() -> None:
    found, reports = dict[str, set[str]](), set[str]()
    for command, param in parameters():
        if "--json" in param.opts:
            reports.add(command)
        if isinstance(param, click.Option) and not param.is_flag and not isinstance(param.type, click.Choice):
            found.setdefault(param.opts[0], set()).add(param.make_metavar(click.Context(lightpage)))
    every = set[str]().union(*found.values())
    assert not every & {"TEXT", "DIRECTORY", "INTEGER", "INTEGER RANGE", "FLOAT", "FLOAT RANGE", "P"}
    several = {name: sorted(names) for name, names in found.items() if len(names) > 1}
    assert set(several) <= {"--out", "--recordings", "--pages", "--volume"}  # of files, of folders, of many, to choose
    silent = {"new", "serve", "virtual-device"}  # a file alone, or what runs until it is ended
    assert {name for name, _ in parameters()} - reports <= silent | {"bulk"}


@pytest.mark.parametrize(
    ("line", "subject", "got", "wanted"),
    [
        ("simulat", "lightpage", "simulat", "simulate"),
        ("evaluate --bundel x", "lightpage evaluate", "--bundel", "--bundle"),
        ("evaluate", "lightpage evaluate", "--recording", "RECORDING"),
        ("simulate --pages 0", "lightpage simulate --pages", "0", "at least 1"),
        ("profile check a b", "lightpage profile check", "too many: b", "--help"),
        ("bulk evaluate out --engine no", "lightpage bulk evaluate --engine", "no", "local"),
        ("evaluate --recording= ", "--recording", "empty", "path"),
        ("evaluate --bundle nosuch --recording R.h5", "bundle nosuch", "no such", "bench"),
    ],
)
def test_a_wrong_line_is_told_in_one_line(
    line: str, subject: str, got: str, wanted: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(lightpage, line.split()) == EXIT_ERROR
    (told,) = capsys.readouterr().err.splitlines()
    assert told.startswith(f"lightpage: error: {subject}: got ")
    came, _, expected = told.removeprefix("lightpage: error: ").partition(", wanted ")
    assert got in came
    assert wanted in expected


@pytest.mark.parametrize("words", [[], ["profile"]])
def test_without_a_command_the_help_is_shown_as_it_is(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert run(lightpage, words) == EXIT_ERROR
    assert "\nCommands:\n" in capsys.readouterr().err


def test_a_name_that_is_too_long_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(lightpage, ["bulk", "decode", "n" * 300, "--recordings", "R.h5"]) == 2
    assert capsys.readouterr().err.startswith("lightpage: error: ")


@pytest.mark.parametrize(
    ("error", "named"),
    [
        (MemoryError("Unable to allocate 3 MiB"), "memory"),
        (RuntimeError("can't start new thread"), "ulimit -u"),
        (OSError(errno.EMFILE, os.strerror(errno.EMFILE)), "ulimit -n"),
        (ImportError("libx.so: failed to map segment from shared object"), "memory"),
    ],
)
def test_a_short_resource_is_one_line(error: Exception, named: str, capsys: pytest.CaptureFixture[str]) -> None:
    @click.command()
    def command() -> None:
        raise error

    assert run(command, []) == EXIT_ERROR
    told = capsys.readouterr().err
    assert told.startswith("lightpage: error: ")
    assert told.count("\n") == 1
    assert named in told


def test_words_of_a_library_name_a_resource_where_it_has_no_number() -> None:
    error = OSError("Unable to open file (memory allocation failed)")
    assert isinstance(os_failure("recording R", error, "a file", RecordingError), SurroundingsError)
    assert isinstance(understood("B", MemoryError()), SurroundingsError)
    assert understood("bundle B", ValueError("bad magic")) is None


def test_progress_is_plain_lines_now_and_then_where_stderr_is_no_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = HandClock()
    monkeypatch.setattr(tqdm.std, "time", clock.now)
    with progress_bar.percent_bar() as progress:
        for step in range(4):
            clock.advance(progress_bar.LINE_S)
            progress("fit", step / 4)
    for _ in progress_bar.Bars().track(range(30), "pages", "page", None, 0, lambda: "AIR 5"):
        clock.advance(progress_bar.LINE_S / 10 + 1e-3)
    told = capsys.readouterr()
    assert told.out == ""
    lines = [line for line in told.err.splitlines() if line]
    assert lines[0].startswith("lightpage: fit: ")
    assert any(line.startswith("lightpage: done: 100% after 02:00") for line in lines)
    pages = [line for line in lines if line.startswith("lightpage: pages: ")]
    assert 2 <= len(pages) <= 4
    assert pages[0].endswith(", AIR 5")
    assert "\r" not in told.err


def test_short_work_says_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    assert list(progress_bar.Bars().track(range(3), "pages", "page", None, 0, lambda: "")) == [0, 1, 2]
    assert capsys.readouterr().err.strip() == ""
