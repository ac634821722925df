"""What a concentration promises, against the density's own integrals."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

from lightpage.von_mises import information, mean_resultant


@pytest.mark.parametrize("kappa", [0.0, 0.3, 4.0, 60.0])
def test_promises_are_integrals_of_the_density(kappa: float) -> None:
    def weight(angle: float) -> float:
        return float(np.exp(kappa * (np.cos(angle) - 1)))

    total, _ = quad(weight, -np.pi, np.pi)
    cosine, _ = quad(lambda angle: weight(angle) * np.cos(angle), -np.pi, np.pi)
    told, _ = quad(lambda angle: weight(angle) / total * np.log(2 * np.pi * weight(angle) / total), -np.pi, np.pi)
    assert mean_resultant(np.array([kappa]))[0] == pytest.approx(cosine / total, abs=1e-9)
    assert information(np.array([kappa]))[0] == pytest.approx(told, abs=1e-9)


def test_a_narrow_density_tells_as_a_normal_one_does() -> None:
    expected = np.log(2 * np.pi) - np.log(2 * np.pi * np.e / 5000) / 2
    assert information(np.array([5000.0]))[0] == pytest.approx(expected, abs=1e-3)
