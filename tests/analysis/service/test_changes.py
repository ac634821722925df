"""The judge of answers under model changes finds what it looks for."""

from __future__ import annotations

from analysis.service.changes import _Answered, _Changed, judged

EXPECTED = {"a": "A", "b": "B"}
CHANGED = [_Changed(0.0, 0.0, "a"), _Changed(1.0, 2.0, "b"), _Changed(5.0, 6.0, "a")]


def test_answers_of_models_that_were_in_service_are_good() -> None:
    good = [
        _Answered(0.5, 0.9, "a", "A"),
        _Answered(0.5, 1.5, "b", "B"),  # the change was under way
        _Answered(1.5, 3.0, "a", "A"),
        _Answered(1.5, 3.0, "b", "B"),
        _Answered(3.0, 4.0, "b", "B"),
        _Answered(6.5, 7.0, "a", "A"),
    ]
    assert judged(good, CHANGED, EXPECTED) == {"answers": 6, "failed": 0, "wrong_or_mixed": 0, "stale": 0}


def test_failed_wrong_and_stale_ones_are_counted() -> None:
    bad = [
        _Answered(3.0, 4.0, "UNAVAILABLE", ""),
        _Answered(3.0, 4.0, "b", "A"),
        _Answered(3.0, 4.0, "a", "A"),
        _Answered(0.2, 0.4, "b", "B"),
    ]
    assert judged(bad, CHANGED, EXPECTED) == {"answers": 4, "failed": 1, "wrong_or_mixed": 1, "stale": 2}
