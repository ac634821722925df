"""What an error says."""

from pathlib import Path

import pytest

from lightpage.errors import InvalidInputError
from lightpage.files import replace_text


def test_an_error_names_the_thing_what_came_and_what_was_wanted() -> None:
    error = InvalidInputError("--pages", 0, "at least 1")
    assert str(error) == "--pages: got 0, wanted at least 1"


def test_an_error_of_the_operating_system_is_told_in_words(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError) as caught:
        replace_text(tmp_path / "missing" / "F", "text")
    assert caught.value.got == "No such file or directory"


def test_an_error_of_a_library_keeps_its_words() -> None:
    assert InvalidInputError("file F", OSError("truncated file"), "a whole one").got == "truncated file"
