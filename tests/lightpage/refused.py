"""Assertion on what an error names, without the sentence that it makes of it."""

from collections.abc import Generator
from contextlib import contextmanager

import pytest

from lightpage.errors import InvalidInputError, LightpageError


@contextmanager
def refused(
    subject: str = "", got: object = "", kind: type[LightpageError] = InvalidInputError, wanted: object = ""
) -> Generator[None]:
    """Inside, an error of a class is raised, with the arguments in what it says of each."""
    with pytest.raises(kind) as caught:
        yield
    assert subject in caught.value.subject
    assert str(got) in caught.value.got
    assert str(wanted) in caught.value.expected
