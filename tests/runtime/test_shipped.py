"""A shipped bundle's name means that bundle, wherever the command is called."""

from __future__ import annotations

from pathlib import Path

import pytest

from runtime.shipped import DEFAULT, bundle_path


def test_a_name_is_the_shipped_bundle_even_beside_a_folder_of_that_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / DEFAULT).mkdir()
    monkeypatch.chdir(tmp_path)
    assert bundle_path(DEFAULT).name == f"{DEFAULT}.zip"
    assert bundle_path(DEFAULT).is_file()
    assert bundle_path(f"./{DEFAULT}") == Path(DEFAULT)


@pytest.mark.parametrize("given", ["mine.zip", "runs/bench", "nothing-of-that-name"])
def test_anything_else_is_a_path(given: str) -> None:
    assert bundle_path(given) == Path(given)
