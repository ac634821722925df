"""Pages of a file, and behind them those that were uploaded."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lightpage.errors import InvalidInputError, LimitError, PageError
from lightpage.recording.pages import Pages
from runtime.acquisition.page_store import PageStore
from tests.runtime import toy
from tests.runtime.acquisition.lab import pages_of


def test_uploaded_pages_follow_those_of_the_file(tmp_path: Path) -> None:
    store = pages_of(tmp_path, 2)
    more = np.stack([toy.symbols_of(16, number)[0] for number in (7, 8)])
    store.most_bytes = 2 * more.nbytes
    assert store.append(more, 16) == 2
    assert store.append(more[0], 16) == 4
    assert (len(store), store.levels) == (5, 16)
    for page, number in enumerate((0, 1, 7, 8, 7)):
        assert (store[page] == toy.symbols_of(16, number)[0]).all()
    for wrong in (-1, 5):
        with pytest.raises(PageError):
            store[wrong]
    with pytest.raises(InvalidInputError, match="16"):
        store.append(more % 8, 8)
    with pytest.raises(PageError):
        store.append(more, 4)
    with pytest.raises(PageError):
        store.append(more[:, :-1], 16)
    with pytest.raises(LimitError):
        store.append(more, 16)
    assert store.append(more[0], 16) == 5  # exactly full
    store.close()


def test_pages_for_another_profile_are_refused(tmp_path: Path) -> None:
    pages_of(tmp_path).close()
    page = toy.PROFILE.page.model_copy(update={"rows": toy.PROFILE.page.rows + 1})
    with pytest.raises(InvalidInputError):
        PageStore(toy.PROFILE.model_copy(update={"page": page}), Pages.open(tmp_path / "pages.h5"))


def test_levels_of_an_empty_store_are_those_of_the_first_upload_unless_it_was_told() -> None:
    store = PageStore(toy.PROFILE)
    assert (store.levels, store.code, len(store)) == (None, None, 0)
    with pytest.raises(PageError):
        store[0]
    assert store.append(toy.symbols_of(8, 1), 8) == 0
    assert store.levels == 8
    with pytest.raises(InvalidInputError):
        PageStore(toy.PROFILE, levels=16).append(toy.symbols_of(8, 1), 8)
    with pytest.raises(PageError):
        PageStore(toy.PROFILE, levels=1)
