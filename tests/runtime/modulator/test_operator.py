from __future__ import annotations

import pytest

from runtime.errors import SourceError
from runtime.modulator.operator import OperatorBeams


def test_a_person_is_asked_for_what_is_to_change_and_for_nothing_else() -> None:
    asked: list[str] = []
    beams = OperatorBeams(asked.append)
    beams.let_through(signal=True, reference=True)
    assert asked == []
    beams.let_through(signal=False, reference=True)
    beams.let_through(signal=False, reference=True)
    beams.let_through(signal=True, reference=False)
    beams.let_through(signal=False, reference=False)
    beams.close()
    beams.close()
    assert asked == [
        "Block the signal beam",
        "Let the signal beam through and block the reference beam",
        "Block the signal beam",
        "Let the signal beam through and let the reference beam through",
    ]


def test_where_there_is_nobody_to_ask_the_beams_count_as_they_were() -> None:
    asked: list[str] = []

    def ask(sentence: str) -> None:
        asked.append(sentence)
        if len(asked) == 1:
            raise SourceError("beams", "nobody to ask", "a terminal")

    beams = OperatorBeams(ask)
    with pytest.raises(SourceError, match="nobody to ask"):
        beams.let_through(signal=False, reference=True)
    beams.close()
    assert asked == ["Block the signal beam"]
    beams.let_through(signal=False, reference=True)
    assert len(asked) == 2
