"""Pages gathered one by one, against the same figures of all of them at once."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest

from optics import measures
from optics.errors import PageError
from optics.tally import Tally


@pytest.mark.parametrize("levels", [6, 16])
def test_pages_one_by_one_give_the_figures_of_all_at_once(levels: int) -> None:
    rng = np.random.default_rng(levels)
    data = rng.random((9, 11)) > 0.2
    # few different concentrations: bins of equal count part symbols that tie
    kappa = rng.choice([0, 0.5, 4, 4.25, 60, 1e12], (5, np.count_nonzero(data))).astype(np.float32)
    symbols = rng.integers(levels, size=kappa.shape).astype(np.uint8)
    mu = (symbols * 2 * np.pi / levels + 0.3 * rng.standard_normal(kappa.shape)).astype(np.float32)
    tally = Tally(levels, data, pages=7)
    for page in zip(mu, kappa, symbols, strict=True):
        tally.add(*page)
    got_figures, wanted_figures = (
        {name: np.nan if value is None else value for name, value in asdict(figures).items()}
        for figures in (tally.figures(), measures.measure(mu, kappa, symbols, levels))
    )
    assert got_figures == pytest.approx(wanted_figures, rel=1e-12, nan_ok=True)
    assert tally.pages == tuple(measures.measure(*page, levels) for page in zip(mu, kappa, symbols, strict=True))
    for got, wanted in zip(
        vars(tally.maps()).values(), vars(measures.symbol_maps(mu, kappa, symbols, levels, data)).values(), strict=True
    ):
        np.testing.assert_allclose(got, wanted, rtol=1e-12, atol=1e-14)
    decided, confidence = measures.decide_with_confidence(mu, kappa, levels)
    for claims, wanted_claims in zip(
        tally.confidence_bins(), measures.reliability(confidence, decided == symbols), strict=True
    ):
        assert asdict(claims) == pytest.approx(asdict(wanted_claims), rel=1e-12)
    for promises, wanted_promises in zip(
        tally.concentration_bins(), measures.concentration_calibration(mu, kappa, symbols, levels), strict=True
    ):
        # half a float32 step of a cosine
        assert asdict(promises) == pytest.approx(asdict(wanted_promises), rel=1e-12, abs=2**-25)


def test_no_page_has_no_figures() -> None:
    with pytest.raises(PageError, match="pages to measure: got none"):
        Tally(16, np.ones((2, 3), bool), pages=4).figures()
