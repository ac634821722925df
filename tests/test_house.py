"""The house stays small: its rooms, floors, arrows, folders and lines have limits."""

from __future__ import annotations

import pytest

from tests import house


@pytest.fixture(scope="module")
def figures() -> dict[str, float]:
    return house.figures()


@pytest.mark.parametrize("name", house.limits())
def test_a_figure_is_within_its_limit(name: str, figures: dict[str, float]) -> None:
    assert figures[name] <= house.limits()[name]


def test_lines_of_code_are_counted_without_docstrings_comments_and_blank_lines() -> None:
    source = (
        '"""One."""\n\n# two\nx = (\n    1\n)\n"""Three."""\n\n\ndef f():\n    """Four."""\n    return """\n\n"""\n'
    )
    assert house.code_lines(source) == 3 + 1 + 3
