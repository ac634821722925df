"""A file's name that is no text can be told wherever a command writes."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

CODE = """
import sys
import click
from lightpage.cli import main
main.lightpage = click.Command("c", callback=lambda: print(sys.argv[1]))
main.run = lambda command: command.main([], standalone_mode=False) or 0
main.main()
"""


@pytest.mark.parametrize("encoding", ["utf-8:strict", "ascii:strict"])
def test_a_name_that_is_no_text_does_not_end_a_command(encoding: str) -> None:
    name = os.fsdecode(b"a\xff.h5")
    there = os.environ | {"PYTHONIOENCODING": encoding}
    done = subprocess.run([sys.executable, "-c", CODE, name], env=there, capture_output=True, timeout=60)
    assert (done.returncode, done.stdout) == (0, b"a\\udcff.h5\n")
