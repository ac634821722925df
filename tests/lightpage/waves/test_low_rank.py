"""Expansions sum to the phase's phasor, about as well as asked; between sparse samples light of a band is known."""

import numpy as np
import pytest

from lightpage.waves import low_rank as expansion
from lightpage.waves.low_rank import Expansion, Interpolation, Phase, Real
from lightpage.waves.sinc_interpolation import interpolation, sparse_axis

TOLERANCE = 1e-4
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


@pytest.mark.parametrize(("strength", "rank"), [(0.5, 10), (6.0, 60)])
def test_the_terms_are_the_leading_ones_however_many_they_are(
    strength: float, rank: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    # (measured) of few and many; what is dropped is below the tolerance each
    phase = phase_of(strength)
    errors = []
    for looked_for_at_first in (expansion.SKETCH, 10**9):
        monkeypatch.setattr(expansion, "SKETCH", looked_for_at_first)
        found = Expansion.of(phase, FIRST, SECOND, TOLERANCE)
        assert len(found.first) == rank
        total = sum(np.multiply.outer(first, second) for first, second in found.terms())
        errors.append(np.linalg.norm(total - exact(phase)) / np.linalg.norm(exact(phase)))
    assert errors[0] < 1.01 * errors[1] < TOLERANCE * rank


@pytest.mark.parametrize(("strength", "tolerance", "rank"), [(12.0, TOLERANCE, 132), (3.0, 1e-6, None)])
def test_of_more_terms_than_are_looked_for_at_first_and_near_rounding_none_lacks(
    strength: float, tolerance: float, rank: int | None
) -> None:
    phase = phase_of(strength)
    found = Expansion.of(phase, FIRST, SECOND, tolerance)
    assert rank is None or len(found.first) == rank
    total = sum(np.multiply.outer(first, second) for first, second in found.terms())
    assert np.linalg.norm(total - exact(phase)) / np.linalg.norm(exact(phase)) < tolerance * (rank or 10)


@pytest.mark.parametrize(("tolerance", "most"), [(0.03, 8), (0.003, 16)])
def test_a_phasor_is_interpolated_from_nodes_of_each_tile(tolerance: float, most: int) -> None:
    strengths = 0.5, 2.0  # of two tiles
    tiles = [[phase_of(strength), phase_of(1.05 * strength)] for strength in strengths]
    terms = Interpolation.of(tiles, FIRST, SECOND, tolerance)
    assert 1 < terms.nodes.shape[1] <= most
    (across, up), errors = SECOND, []
    for strength, nodes, coefficients in zip(strengths, terms.nodes[..., None, None], terms.weights, strict=True):
        weights = terms.axes[0] @ coefficients @ terms.axes[1].T
        for share in (1.0, 1.02, 1.05):
            phase = phase_of(share * strength)
            at_nodes = np.exp(1j * phase(nodes[:, 0], nodes[:, 1], across[None, None, :], up[None, :, None]))
            total = np.tensordot(weights, at_nodes, ([0], [0]))
            errors.append(np.linalg.norm(total - exact(phase)) / np.linalg.norm(exact(phase)))
    # the ends, where polynomials fit worst, count more among few samples than in an integral
    assert np.sqrt(np.mean(np.square(errors))) < 2 * tolerance
    fewer = Interpolation.of(tiles, FIRST, SECOND, 3 * tolerance)
    assert fewer.nodes.shape[1] < terms.nodes.shape[1]


HIGHEST = 42e3
"""Cycles a metre."""
PITCH = 1 / (6 * HIGHEST)
PLACES = 3e-4 + PITCH * np.arange(300)
WORST = 1e-4
"""Error that the module promises for the edge of the band."""


def waves(places: np.ndarray) -> np.ndarray:
    """Plane waves of the whole band at places, as large as samples are."""
    along = np.outer(places, np.linspace(-HIGHEST, HIGHEST, 101))
    return np.asarray(np.exp(2j * np.pi * along) * np.sqrt(places[1] - places[0]))


@pytest.mark.parametrize("finer", [1, 2, 7])
def test_light_of_the_band_is_interpolated_everywhere_on_the_axis(finer: int) -> None:
    places = np.linspace(PLACES[0], PLACES[-1], finer * len(PLACES))
    sparse = sparse_axis(places, HIGHEST)
    assert len(sparse) < 0.6 * len(places) / finer
    expected = waves(places)
    error = np.abs(interpolation(places, sparse) @ waves(sparse) - expected) / np.abs(expected)
    assert error.max() < WORST


def test_few_samples_serve_where_less_will_do() -> None:
    sparse = sparse_axis(PLACES, HIGHEST, 1.1)
    assert len(sparse) < len(sparse_axis(PLACES, HIGHEST))
    error = interpolation(PLACES, sparse, 1.1) @ waves(sparse) - waves(PLACES)
    assert np.linalg.norm(error) < 0.003 * np.linalg.norm(waves(PLACES))


@pytest.mark.parametrize("step", [2, 3])
def test_an_axis_with_no_more_places_than_samples_stays_as_it_is(step: int) -> None:
    places = PLACES[::step]
    assert sparse_axis(places, HIGHEST) is places
    np.testing.assert_allclose(interpolation(places, places), np.eye(len(places)), atol=1e-12)
