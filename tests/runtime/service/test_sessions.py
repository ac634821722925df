"""Sessions: bounded, the one silent for longest goes first, and no name stands for another's."""

from __future__ import annotations

from runtime.service.sessions import Sessions, named_session, own_name


def test_many_sessions_are_bounded() -> None:
    made = list[object]()
    sessions = Sessions(lambda: made.append(object()) or made[-1], most=3)  # type: ignore[arg-type,return-value,func-returns-value]
    first = sessions.tracker("0")
    for number in range(1, 3):
        sessions.tracker(str(number))
    assert sessions.tracker("0") is first
    sessions.tracker("3")
    assert sessions.tracker("0") is first
    sessions.tracker("1")
    assert len(made) == 5


def test_names_of_different_callers_are_different() -> None:
    assert own_name("7/job", "line") != own_name("job", "line/7")
    assert own_name("job", "") == "job"
    assert named_session("job", "line") == f"session {own_name('job', 'line')}"
