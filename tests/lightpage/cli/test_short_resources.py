"""A resource that is short ends a command in one line that names it, wherever it was wanted."""

from __future__ import annotations

import errno
import os

import click
import pytest

from lightpage.cli.main import EXIT_ERROR, run
from lightpage.errors import Cause, RecordingError, SurroundingsError
from lightpage.failures import os_failure, understood


@pytest.mark.parametrize(
    ("error", "named"),
    [
        (MemoryError("Unable to allocate 3 MiB"), "memory"),
        (RuntimeError("can't start new thread"), "ulimit -u"),
        (OSError(errno.EMFILE, os.strerror(errno.EMFILE)), "ulimit -n"),
        (OSError(errno.ENFILE, os.strerror(errno.ENFILE)), "open files"),
        (OSError(errno.ENOMEM, os.strerror(errno.ENOMEM)), "memory"),
        (BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN)), "ulimit -u"),
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
    error = os_failure(
        "recording R", OSError("Unable to open file (memory allocation failed)"), "a file", RecordingError
    )
    assert isinstance(error, SurroundingsError)
    assert error.cause is Cause.SURROUNDINGS
    assert isinstance(understood("B", MemoryError()), SurroundingsError)
    assert understood("bundle B", ValueError("bad magic")) is None
