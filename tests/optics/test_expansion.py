"""Claims about expansions: their terms sum to the phase's phasor, about as well as asked, with few terms or many."""

from __future__ import annotations

import numpy as np
import pytest

from optics.expansion import Expansion, Interpolation, Phase, Real

FIRST = np.linspace(-1.0, 1.2, 31), np.linspace(-0.8, 0.8, 23)
SECOND = np.linspace(-0.5, 0.5, 29), np.linspace(-0.6, 0.7, 19)


def phase_of(strength: float) -> Phase:
    """Radians between two planes, of the kind that a lens adds."""

    def phase(x: Real, y: Real, across: Real, up: Real) -> Real:
        return np.asarray(strength * (x * across + y * up) * (x * x + y * y + 0.5 * across))

    return phase


def exact(phase: Phase) -> np.ndarray:
    (x, y), (across, up) = FIRST, SECOND
    at = phase(x[None, :, None, None], y[:, None, None, None], across[None, None, None, :], up[None, None, :, None])
    return np.exp(1j * at)


@pytest.mark.parametrize(("strength", "fewest"), [(0.5, 3), (6.0, 40)])
def test_the_terms_sum_to_the_phasor(strength: float, fewest: int) -> None:
    phase = phase_of(strength)
    expansion = Expansion.of(phase, FIRST, SECOND, 1e-4)
    assert fewest <= len(expansion.first) < 300
    total = sum(np.multiply.outer(first, second) for first, second in expansion.terms())
    error = np.linalg.norm(total - exact(phase)) / np.linalg.norm(exact(phase))
    assert error < 1e-3


@pytest.mark.parametrize("strength", [0.5, 6.0])
def test_a_phasor_is_interpolated_from_its_nodes(strength: float) -> None:
    phases = [phase_of(strength), phase_of(1.05 * strength)]
    terms = Interpolation.of(phases, FIRST, SECOND, 1e-4)
    (across, up), nodes = SECOND, terms.nodes[:, :, None, None]
    weights = terms.axes[0] @ terms.weights @ terms.axes[1].T
    for phase in (*phases, phase_of(1.02 * strength)):
        at_nodes = np.exp(1j * phase(nodes[:, 0], nodes[:, 1], across[None, None, :], up[None, :, None]))
        total = np.tensordot(weights, at_nodes, ([0], [0]))
        assert np.linalg.norm(total - exact(phase)) / np.linalg.norm(exact(phase)) < 1e-2
