"""A code is found for what pages are like, whatever the shape of their noise, and pages written with it are read."""

from collections.abc import Sequence
from unittest.mock import Mock

import numpy as np
import pytest

from lightpage.codec.choose import (
    Choice,
    Draw,
    DrawnPage,
    Drift,
    bytes_without_headroom,
    choose,
    needed_information,
    survives,
)
from lightpage.codec.page_codec import PageCodec
from lightpage.page.levels import Levels
from lightpage.page.symbols import symbol_phases
from tests.lightpage.codec.light import header_of, pilot_mask, written
from tests.lightpage.refused import refused

SHAPE = (32, 48)
PILOTS = pilot_mask(SHAPE)
KAPPA = 2000.0


def light(
    symbols: np.ndarray, levels: int, kappa: float, lost_share: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Phases and concentrations of symbols, of which a share shows nothing and is known to show nothing."""
    lost = rng.random(symbols.shape) < lost_share
    error = np.where(lost, rng.uniform(-np.pi, np.pi, symbols.shape), rng.vonmises(0, kappa, symbols.shape))
    return symbol_phases(symbols, levels) + error, np.where(lost, 0.01, kappa)


def drawn_by(pages: int, kappa: float, lost_share: float = 0.0, claimed: float = 1.0) -> Draw:
    """Draws pages, whose concentrations claim so many times what is true."""

    def draw(levels: int, rng: np.random.Generator) -> Sequence[DrawnPage]:
        count = int(np.count_nonzero(~PILOTS))
        drawn = [rng.integers(0, levels, count).astype(np.uint8) for _ in range(pages)]
        shown = [light(each, levels, kappa, lost_share, rng) for each in drawn]
        return [
            DrawnPage(phase, claimed * kappas, each, Levels(levels))
            for (phase, kappas), each in zip(shown, drawn, strict=True)
        ]

    return draw


def choose_by(
    pages: int, kappa: float, lost_share: float, air_bits: float, drift: Drift | None = None
) -> tuple[Choice, list[Choice]]:
    return choose(drawn_by(pages, kappa, lost_share), air_bits, PILOTS, drift=drift)


@pytest.mark.parametrize(("lost_share", "some_in_cosets"), [(0.0, True), (0.02, False)])
def test_pages_are_read_with_the_code_that_was_chosen_by_their_like(
    lost_share: float, some_in_cosets: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    measured = Mock(wraps=needed_information)
    monkeypatch.setattr("lightpage.codec.choose.needed_information", measured)
    chosen, tried = choose_by(3, KAPPA, lost_share, 4.2)
    levels = [call.args[1][0].levels.count for call in measured.call_args_list]
    assert levels.count(chosen.code.levels) <= 3  # few codes are tried
    assert (chosen.code.coded_bits < chosen.code.level_bits) == some_in_cosets
    assert chosen.user_bytes == max(each.user_bytes for each in tried)
    codec, rng = PageCodec(chosen.code, PILOTS), np.random.default_rng(8)
    for page in range(3):
        data, symbols = written(codec, header_of(codec, page=page), rng)
        assert codec.decode(*light(symbols, chosen.code.levels, KAPPA, lost_share, rng)).data == data


def test_fewer_levels_are_tried_where_none_near_the_rate_carries() -> None:
    chosen, tried = choose_by(3, 50.0, 0.0, 7.5)  # a rate that no such page has
    assert chosen.code.levels < 64
    assert len(tried) == 1


def test_pages_that_nothing_carries_are_refused_with_what_they_were() -> None:
    with refused(got="4 that carry 0.10 bits"):
        choose_by(4, KAPPA, 0.9, 0.1)
    with refused(got=2):  # too few
        choose_by(2, KAPPA, 0.0, 4.0)


def test_a_code_survives_the_drift_that_it_was_chosen_for_and_says_what_that_costs() -> None:
    before = drawn_by(3, KAPPA)
    little, much = (Drift(before, drawn_by(3, KAPPA / more, claimed=more)) for more in (1.1, 1.4))
    plain, _ = choose_by(3, KAPPA, 0.0, 4.2)
    sure, _ = choose_by(3, KAPPA, 0.0, 4.2, drift=much)
    assert [survives(plain, drift, PILOTS)[0] for drift in (little, much)] == [True, False]
    assert [survives(sure, drift, PILOTS)[0] for drift in (little, much)] == [True, True]
    assert survives(plain, little, PILOTS)[1] < plain.spare < survives(plain, much, PILOTS)[1] < sure.spare
    assert sure.user_bytes < plain.user_bytes
    assert bytes_without_headroom(sure, PILOTS) > sure.user_bytes
