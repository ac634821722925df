"""Options that name files to write."""

from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from optics.errors import InvalidInputError
from optics.files import OutputFile, replace_text


@click.command()
@click.option("--json", "path", type=OutputFile())
def write(path: Path) -> None:
    """A command with nothing but a result."""
    replace_text(path, "text")


@pytest.mark.parametrize(
    ("name", "said"),
    [("", r"--json .*got a folder, wanted a file"), ("missing/F", r"--json .*F: got No such file or directory")],
)
def test_a_path_that_cannot_be_written_is_known_before_the_work(tmp_path: Path, name: str, said: str) -> None:
    with pytest.raises(InvalidInputError, match=said):
        CliRunner().invoke(write, ["--json", str(tmp_path / name)], catch_exceptions=False)


def test_a_path_that_can_be_written_leaves_nothing_beside_the_result(tmp_path: Path) -> None:
    (tmp_path / "F").write_text("earlier")
    result = CliRunner().invoke(write, ["--json", str(tmp_path / "F")], catch_exceptions=False)
    assert result.exit_code == 0
    assert [path.name for path in tmp_path.iterdir()] == ["F"]
    assert (tmp_path / "F").read_text() == "text"
