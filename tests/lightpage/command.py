"""Commands within this process."""

import click
from click.testing import CliRunner


def run(command: click.Command, *words: object) -> str:
    """Return what a command prints; its errors are raised."""
    result = CliRunner().invoke(command, [str(word) for word in words], standalone_mode=False, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output
