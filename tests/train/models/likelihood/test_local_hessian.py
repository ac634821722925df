"""The local Hessian is that of a convolution, and its solution is that of its equations."""

import numpy as np
import pytest
import torch

from lightpage.train.models.likelihood.local_hessian import DAMPING, LocalHessian
from lightpage.train.models.likelihood.modulator import summed, to_samples

SAMPLES = 4
SHAPE = (5, 7)
SPREAD = torch.tensor([1.0, 0.43, -0.09, 0.04, 0.0, -0.02, 0.03])


def hessian(precision: float) -> LocalHessian:
    turn = torch.from_numpy(np.random.default_rng(0).uniform(-np.pi, np.pi, SHAPE)).float()
    direction = to_samples(torch.cos(turn), SAMPLES), to_samples(torch.sin(turn), SAMPLES)
    return LocalHessian(direction, torch.full(SHAPE, 50.0), SPREAD, torch.tensor(precision))


def matrix(precision: float) -> np.ndarray:
    """The Hessian by the samples' phases, with precision and damping of what differs from each symbol's mean."""
    rows, columns = (SAMPLES * count for count in SHAPE)
    turn = np.random.default_rng(0).uniform(-np.pi, np.pi, SHAPE)
    light = np.exp(1j * np.kron(turn, np.ones((SAMPLES, SAMPLES)))).ravel()
    taps = np.concatenate([SPREAD.numpy(), np.zeros(rows + columns)])
    along, down = (taps[np.abs(np.subtract.outer(np.arange(n), np.arange(n)))] for n in (columns, rows))
    of_symbol = sum(taps[abs(i - j)] for i in range(SAMPLES) for j in range(SAMPLES)) ** 2
    spread = 50.0 / of_symbol * np.kron(down, along) * (np.conj(light)[:, None] * light).real
    number = np.arange(rows * columns).reshape(SHAPE[0], SAMPLES, SHAPE[1], SAMPLES)
    mean = np.zeros_like(spread)
    for own in number.transpose(0, 2, 1, 3).reshape(-1, SAMPLES**2):
        mean[np.ix_(own, own)] = 1 / SAMPLES**2
    return np.asarray(spread + (precision + DAMPING * 50 / SAMPLES**2) * (np.eye(rows * columns) - mean))


@pytest.mark.parametrize("precision", [2.0, 1e12], ids=["deviations", "none"])
def test_the_solution_is_that_of_the_equations(precision: float) -> None:
    gradient = 0.1 * np.random.default_rng(1).standard_normal([SAMPLES * count for count in SHAPE])
    phases, deviations = hessian(precision).solve(torch.from_numpy(gradient).float(), torch.zeros(gradient.shape))
    exact = np.linalg.solve(matrix(min(precision, 1e6)), gradient.ravel()).reshape(gradient.shape)
    expected = summed(torch.from_numpy(exact), SAMPLES).numpy() / SAMPLES**2
    np.testing.assert_allclose(phases, expected, atol=0.02 * np.abs(expected).max())
    assert torch.allclose(summed(deviations, SAMPLES), torch.zeros(SHAPE), atol=1e-5)
    beside = exact - np.kron(expected, np.ones((SAMPLES, SAMPLES)))
    assert np.corrcoef(deviations.numpy().ravel(), beside.ravel())[0, 1] > 0.99 or precision > 1e6


def test_without_deviations_phases_are_solved_alone() -> None:
    gradient = torch.from_numpy(np.random.default_rng(1).standard_normal([SAMPLES * count for count in SHAPE])).float()
    phases, deviations = hessian(2.0).solve(gradient, None)
    stiff, _ = hessian(1e12).solve(gradient, torch.zeros_like(gradient))
    torch.testing.assert_close(phases, stiff, rtol=1e-3, atol=1e-4)
    assert not deviations.any()
