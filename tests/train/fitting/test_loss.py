"""The von Mises loss."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import stats

from lightpage.metrics.information import achievable_rate
from train.fitting.loss import training_rate, von_mises_nll


def test_it_is_the_density_that_scipy_has() -> None:
    kappa, mu, theta = np.array([0.1, 2.0, 40.0]), np.array([0.3, -2.0, 3.0]), np.array([1.0, 2.5, -3.1])
    p = torch.from_numpy(np.stack([kappa * np.cos(mu), kappa * np.sin(mu)])[None])
    expected = -stats.vonmises.logpdf(theta, kappa, loc=mu)
    got = von_mises_nll(p, torch.from_numpy(theta)[None])[0].numpy()
    np.testing.assert_allclose(got, expected, atol=2e-5)


def test_it_is_finite_with_its_gradient_at_no_and_at_huge_confidence() -> None:
    p = torch.tensor([[[0.0, 1e4], [0.0, 0.0]]], requires_grad=True)
    loss = von_mises_nll(p, torch.zeros(1, 2)).sum()
    loss.backward()
    assert torch.isfinite(loss)
    assert p.grad is not None
    assert torch.isfinite(p.grad).all()


def test_it_is_convex_in_p() -> None:
    generator = torch.Generator().manual_seed(0)
    a, b = torch.randn(2, 500, 2, 1, generator=generator, dtype=torch.float64) * 5
    theta = torch.rand(500, 1, generator=generator, dtype=torch.float64) * 6
    middle = von_mises_nll((a + b) / 2, theta)
    assert torch.all(middle <= (von_mises_nll(a, theta) + von_mises_nll(b, theta)) / 2 + 1e-4)


@pytest.mark.parametrize(("levels", "concentration"), [(2, 100), (16, 100), (100, 4000), (256, 100), (256, 8000)])
def test_the_rate_in_training_is_that_of_the_symbols_whatever_the_piston(levels: int, concentration: float) -> None:
    rng = np.random.default_rng(levels)
    symbols, kappa = rng.integers(levels, size=4000), rng.gamma(2.0, concentration / 2, 4000)
    mu = symbols * 2 * np.pi / levels + rng.vonmises(0, kappa)
    expected = achievable_rate(mu, kappa, symbols, levels).mean()
    for piston in (0.0, 2.1):
        p = torch.from_numpy(kappa * np.stack([np.cos(mu + piston), np.sin(mu + piston)]))
        phases = torch.from_numpy(symbols * 2 * np.pi / levels + piston)
        assert training_rate(p, phases, levels) == pytest.approx(expected, abs=2e-3)
    assert expected < np.log2(levels)
