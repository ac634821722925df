"""Prediction of both frames by a decoded page, and their residual as the next pass takes it."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lightpage.calibration.waves.wave_model import illumination_terms
from lightpage.device.profile import Profile
from lightpage.train.models.field import FieldRecovery, Measured
from lightpage.train.models.localizers.wave import by_symbol
from lightpage.train.models.parts import conjugate, multiply, parts
from lightpage.train.models.waves import EXACT, ROUGH, Fidelity, Real, WaveMatrices, Waves
from lightpage.waves.grid import FieldGrid, symbol_samples


class Prediction(nn.Module):
    """Residual of both frames after decoded symbols are explained, taken back to the modulator.

    Args:
        profile: the nominal device.
        parameters: [P] fitted.
        grid: the common grid, where it is not the usual one.
        to_camera, to_page: how exactly either way is followed.

    Attributes:
        illumination: real and imaginary parts of the factors of `illumination_terms`, [2, 6]; even until fitted.
        floor: see `Measured.pull`; one until it is fitted (`fit_prediction`).
    """

    def __init__(
        self,
        profile: Profile,
        parameters: Real,
        grid: FieldGrid | None = None,
        to_camera: Fidelity = EXACT,
        to_page: Fidelity = ROUGH,
    ) -> None:
        super().__init__()
        self.waves = Waves(profile, parameters, 1, to_camera, filled=True, grid=grid)
        self.back = Waves(profile, parameters, symbol_samples(profile), to_page, filled=True, grid=grid)
        self._half_width, self._half_height = profile.page_width_m / 2, profile.page_height_m / 2
        self.illumination: Tensor
        self.floor: Tensor
        even = torch.zeros(2, len(self.terms()))
        even[0, 0] = 1
        self.register_buffer("illumination", even)
        self.register_buffer("floor", torch.ones(()))

    @property
    def light_channels(self) -> int:
        """Features that carry unexplained light: real parts of a symbol's samples, then imaginary parts."""
        return 2 * self.back.samples**2

    def field(self, at: WaveMatrices, p: Tensor) -> Tensor:
        """Expected field on the common grid, [2, Gy, Gx], of an estimated page p [2, ny, nx]; its scale is open."""
        written = expected_phasors(p)
        illumination = torch.tensordot(self.illumination, torch.stack(self.terms()), 1)
        return self.waves.to_camera(at, torch.stack(multiply(parts(written), parts(illumination))))

    def terms(self) -> list[Tensor]:
        """Factors of the illumination, see `illumination_terms`."""
        return illumination_terms(self.waves.x_m / self._half_width, self.waves.y_m / self._half_height)

    def forward(
        self, recovery: FieldRecovery, measured: Measured, field: Tensor, p: Tensor, parameters: Tensor | None = None
    ) -> Tensor:
        """Light that an estimated page leaves unexplained.

        Args:
            recovery: field recovery of the same device.
            measured, field: measurements and field of the page; the field says how strong its light is.
            p: [2, ny, nx].
            parameters: [P] of a device that has drifted since.

        Returns:
            [2, 1, S, ny, nx], as a localizer gives it.
        """
        at = self.waves.matrices(parameters)
        expected = self.field(at, p)
        real, imaginary = multiply(parts(field), conjugate(parts(expected)))
        gain = torch.stack([real.sum(), imaginary.sum()]) / (expected.square().sum() + 1e-12)
        expected = torch.stack(multiply(parts(expected), parts(gain)))
        left = recovery.innovation(measured, expected, self.floor)
        return by_symbol(self.back.to_page(self.back.matrices(parameters), left), self.back.samples)


def expected_phasors(p: Tensor, axis: int = 0) -> Tensor:
    """Mean of exp(i phase) under von Mises densities, of p with its two numbers along an axis; same shape.

    Its length, a ratio of Bessel functions, lies within 5% of kappa / (1/2 + sqrt(kappa^2 + 9/4)), one of the bounds of
    Amos (Math. Comp. 28, 1974).
    """
    x, y = p.chunk(2, axis)
    return p / (0.5 + torch.sqrt(x * x + y * y + 2.25))
