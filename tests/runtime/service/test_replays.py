"""Answers by request id are bounded, whatever callers send."""

from __future__ import annotations

import pytest

from runtime.errors import NoSourceError
from runtime.service.caller import Caller
from runtime.service.replays import Replays


def test_requests_of_calls_that_failed_take_of_the_room_too() -> None:
    replays, tried = Replays(600, 1 << 20), list[str]()

    def ask(number: int) -> None:
        def fail() -> bytes:
            tried.append(str(number))
            raise NoSourceError("source", "none", "one")

        with pytest.raises(NoSourceError):
            replays.once(f"{number}{'x' * (1 << 17)}", bytes(1 << 17), Caller(), fail)

    for number in range(8):
        ask(number)
    ask(0)  # forgotten
    ask(7)  # not yet
    assert tried == [*"01234567", "0"]
