"""The house stays small: its rooms, floors, arrows and folders have limits, and so have its sentences."""

from pathlib import Path

import pytest

from tests import house, rules


@pytest.fixture(scope="module")
def figures() -> dict[str, float]:
    return house.figures()


@pytest.mark.parametrize("name", house.limits())
def test_a_figure_is_within_its_limit(name: str, figures: dict[str, float]) -> None:
    assert figures[name] <= house.limits()[name]


def test_a_class_is_as_large_as_its_lines_and_methods_and_may_say_why(tmp_path: Path) -> None:
    source = "class A:\n    x = 1\n\n    def f(self): ...\n\n    async def g(self):\n        def h(): ...\n\n\n"
    (path := tmp_path / "a.py").write_text(source + "# Large: a table\n@dataclass\nclass B:\n    y: int\n")
    assert house.classes(path) == [("A", 7, 2, ""), ("B", 2, 0, "a table")]


@pytest.mark.parametrize(("docstring", "percent"), [("Of a page.", 50), ("Offset of a page.", 0)])
def test_docstrings_that_begin_without_their_subject_are_counted(docstring: str, percent: float) -> None:
    text = f'"""{docstring}\n\nArgs:\n    x: {docstring}\n    y: whether.\n"""\nf(help="{docstring}")'
    found = rules.without_subject([text, 'def f():\n    """Return it."""\n'])
    assert list(found.values()) == [percent, 2 * percent, 2 * percent]


def test_long_sentences_of_pages_are_counted_without_code() -> None:
    page = f"# Title\n\nA short one. A{' word' * 25}. Three more words.\n```\nno word\n```\n| a | row |\n"
    assert rules.prose([page]) == {"long_sentences_percent": 33.4}
