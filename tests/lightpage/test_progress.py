"""Progress of work that has parts."""

import pytest

from lightpage.progress import part


def test_the_share_of_a_part_is_one_of_the_whole() -> None:
    told: list[tuple[str, float]] = []
    fit = part(lambda what, share: told.append((what, share)), 0.5, 0.9)
    fit("waves", 0.0)
    fit("waves", 0.25)
    fit("done", 1.0)
    assert [what for what, _ in told] == ["waves", "waves", "done"]
    assert [share for _, share in told] == pytest.approx([0.5, 0.6, 0.9])
