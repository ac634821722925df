"""Pages gathered one by one, against the same figures of all of them at once."""

from dataclasses import asdict

import numpy as np
import pytest
from scipy.special import i0e, i1e

from lightpage.errors import PageError
from lightpage.metrics import information, measures, reliability
from lightpage.metrics.accumulator import Accumulator
from tests.lightpage.refused import refused


@pytest.mark.parametrize("levels", [6, 16])
def test_pages_one_by_one_give_the_figures_of_all_at_once(levels: int) -> None:
    rng = np.random.default_rng(levels)
    data = rng.random((9, 11)) > 0.2
    kappa = rng.choice([0, 0.5, 4, 4.25, 60, 1e12], (5, np.count_nonzero(data))).astype(np.float32)
    symbols = rng.integers(levels, size=kappa.shape).astype(np.uint8)
    mu = (symbols * 2 * np.pi / levels + 0.3 * rng.standard_normal(kappa.shape)).astype(np.float32)
    accumulator = Accumulator(levels, data, pages=7)
    for page in zip(mu, kappa, symbols, strict=True):
        accumulator.add(*page)
    got_figures, wanted_figures = (
        {name: np.nan if value is None else value for name, value in asdict(figures).items()}
        for figures in (accumulator.figures(), measures.measure(mu, kappa, symbols, levels))
    )
    assert got_figures == pytest.approx(wanted_figures, rel=1e-12, nan_ok=True)
    assert accumulator.pages == tuple(measures.measure(*page, levels) for page in zip(mu, kappa, symbols, strict=True))
    for got, expected in zip(
        vars(accumulator.maps()).values(),
        vars(measures.symbol_maps(mu, kappa, symbols, levels, data)).values(),
        strict=True,
    ):
        np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-14)
    decided, confidence = information.decide_with_confidence(mu, kappa, levels)
    for claims, wanted_claims in zip(
        accumulator.confidence_bins(), reliability.reliability(confidence, decided == symbols), strict=True
    ):
        assert asdict(claims) == pytest.approx(asdict(wanted_claims), rel=1e-12)


def test_bins_of_equal_count_hold_the_symbols_in_order_of_concentration() -> None:
    accumulator = Accumulator(16, np.ones((2, 5), bool), pages=3)
    kappa, symbols = np.random.default_rng(1).permutation(np.arange(1, 31.0)).reshape(3, 10), np.zeros(10, int)
    for page in kappa:
        accumulator.add(1 / page, page, symbols)
    bins = accumulator.concentration_bins(bins=4)
    assert [(b.low, b.high, b.count) for b in bins] == [(1, 8, 8), (9, 16, 8), (17, 23, 7), (24, 30, 7)]
    for part in bins:
        ranked = np.arange(part.low, part.high + 1)
        assert part.promised == pytest.approx(np.mean(i1e(ranked) / i0e(ranked)))
        assert part.observed == pytest.approx(np.mean(np.cos(1 / ranked)))
    assert [b.count for b in accumulator.concentration_bins(bins=31)] == [1] * 30


def test_no_page_has_no_figures() -> None:
    with refused("pages to measure", kind=PageError):
        Accumulator(16, np.ones((2, 3), bool), pages=4).figures()
