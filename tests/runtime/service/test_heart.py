"""A decode that does not end is trouble."""

from __future__ import annotations

from runtime.service.heart import Heart


def test_a_decode_that_does_not_end_is_trouble() -> None:
    now = 0.0
    heart = Heart(10.0, lambda: now)
    assert heart.trouble() == ""
    with heart.at_work():
        now = 9.0
        assert heart.trouble() == ""
        with heart.at_work():
            now = 12.0
            assert "12 s" in heart.trouble()
    assert heart.trouble() == ""
