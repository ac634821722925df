"""Features on disk: what an interruption left is taken up, what belongs to something else is not."""

import errno
import os
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from lightpage.errors import LightpageError, SurroundingsError
from lightpage.train.data.feature_store import FeatureStore, fill
from lightpage.train.data.features import PageFeatures, PageState


class Pages:
    """Makes numbered pages and writes down which; stops like Ctrl-C before page `stop`."""

    def __init__(self, stop: int | None = None) -> None:
        self.made: list[int] = []
        self.shifts: list[tuple[float, float]] = []
        self._stop = stop

    def __call__(self, first: int, shift: tuple[float, float]) -> Iterator[PageFeatures]:
        self.shifts.append(shift)
        for number in range(first, 100):
            if number == self._stop:
                raise KeyboardInterrupt
            self.made.append(number)
            yield PageFeatures(
                np.full((2, 3, 4, 5, 6), number, np.float16),
                np.full((2, 5, 6), number, np.float32),
                np.full((5, 6), number, np.float32),
                PageState((number + 0.5, -number), 0.25),
            )


def test_it_goes_on_where_it_was_interrupted(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        fill(tmp_path, "device", 5, Pages(stop=3), "pages")
    rest = Pages()
    fill(tmp_path, "device", 5, rest, "pages")
    assert rest.made[:2] == [3, 4]
    assert rest.shifts == [(2.5, -2)]
    store = FeatureStore(tmp_path)
    assert len(store) == 5
    for number in range(5):
        light, positions, phases = store[number]
        assert light.shape == (24, 5, 6)
        for part in (light, positions, phases):
            assert torch.all(part == number)


def test_estimates_of_an_earlier_pass_are_read_where_earlier_versions_kept_them(tmp_path: Path) -> None:
    def make(first: int, shift: tuple[float, float]) -> Iterator[PageFeatures]:
        return (replace(page, estimate=-page.positions) for page in Pages()(first, shift))

    fill(tmp_path, "device", 2, make, "pages")
    assert {path.stem for path in tmp_path.glob("*.npy")} == {"light", "positions", "belief", "phases", "page_states"}
    _, positions, estimate, _ = FeatureStore(tmp_path)[1]
    torch.testing.assert_close(estimate, -positions, rtol=0, atol=0)


def test_further_processes_take_what_the_first_has_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fill(tmp_path, "device", 3, Pages(), "pages")
    monkeypatch.setenv("LOCAL_RANK", "1")
    other = Pages()
    fill(tmp_path, "device", 3, other, "pages")
    assert other.made == []


@pytest.mark.parametrize(
    ("key", "count", "made"), [("device", 3, 0), ("another device", 3, 3), ("device", 2, 2), ("device", 4, 4)]
)
def test_what_is_complete_is_kept_and_pages_of_something_else_are_made_anew(
    tmp_path: Path, key: str, count: int, made: int
) -> None:
    fill(tmp_path, "device", 3, Pages(), "pages")
    again = Pages()
    fill(tmp_path, key, count, again, "pages")
    assert again.made[:count] == list(range(made))
    assert len(FeatureStore(tmp_path)) == count


def test_a_part_of_the_pages_is_numbered_from_zero(tmp_path: Path) -> None:
    fill(tmp_path, "device", 5, Pages(), "pages")
    part = FeatureStore(tmp_path, range(3, 5))
    assert len(part) == 2
    assert torch.all(part[0][2] == 3)


@pytest.mark.parametrize(
    ("lacking", "number", "kind"),
    [
        ("os.posix_fallocate", errno.ENOSPC, SurroundingsError),
        ("os.posix_fallocate", errno.EOPNOTSUPP, None),
        ("lightpage.train.data.feature_store.open_memmap", errno.ENODEV, LightpageError),
    ],
)
def test_room_is_taken_before_pages_are_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lacking: str, number: int, kind: type[Exception] | None
) -> None:
    monkeypatch.setattr(lacking, Mock(side_effect=OSError(number, os.strerror(number))))
    with pytest.raises(kind) if kind else nullcontext():
        fill(tmp_path, "device", 2, Pages(), "pages")
