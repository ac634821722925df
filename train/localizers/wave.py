"""The wave localizer: the adjoint of the sheared pipe's simulation, run backwards with fitted parameters."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from optics.profile import Profile
from optics.registration.fitted_waves import FittedWaves
from optics.waves import FourierLens, PipePropagator
from train.localizers.coherent import SAMPLES
from train.parts import Parts, adjoint, conjugate, matmul, multiply, parts, stacked

Real = NDArray[np.float64]


class WaveLocalizer(nn.Module):
    """Runs a field back through camera lens, pipe and launch lens to the SLM, by real matrix products.

    It does what `FittedWaves.to_page` does, whose matrices it holds; they are constants of the calibrated device.

    Args:
        profile: the nominal device.
        parameters: [P] fitted (or, for an oracle, true) parameters of the ray twin; the wave model is made from them.
    """

    def __init__(self, profile: Profile, parameters: Real) -> None:
        super().__init__()
        waves = FittedWaves(profile, parameters, SAMPLES)
        channel = waves.channel
        self._rows, self._columns = profile.page_shape
        self.back = _LensToFacet(channel.delaunch_lens, waves.against_reference.conj())
        self.pipe = _PipeBackwards(channel.pipe)
        self.out = _LensToPlane(channel.launch_lens, waves.launch.conj())
        self.window: Tensor
        self.register_buffer("window", torch.from_numpy(channel.entrance_window), persistent=False)

    @property
    def light_channels(self) -> int:
        """Features that carry light: real parts of a symbol's samples, then imaginary parts."""
        return 2 * SAMPLES**2

    def forward(self, field: Tensor) -> Tensor:
        """Field [2, Gy, Gx] to samples [2, 1, S, ny, nx], as the coherent localizer gives them with a single branch."""
        real, imaginary = self.pipe(self.back(parts(field)))
        at_slm = torch.stack(self.out((real * self.window, imaginary * self.window)))
        at_slm = at_slm * torch.rsqrt(at_slm.square().mean() * 2 + 1e-12)
        split = at_slm.reshape(2, self._rows, SAMPLES, self._columns, SAMPLES).permute(0, 2, 4, 1, 3)
        return split.reshape(2, 1, SAMPLES**2, self._rows, self._columns)


class _Lens(nn.Module):
    """The matrices of a lens, and a phasor over its plane [ny, nx]."""

    def __init__(self, lens: FourierLens, phasor: NDArray[np.complexfloating]) -> None:
        super().__init__()
        self.x: Tensor
        self.between: Tensor
        self.y: Tensor
        self.facet: Tensor
        self.plane: Tensor
        self.phasor: Tensor
        for name, value in (
            ("x", lens.x_to_x),
            ("between", lens.y_and_x),
            ("y", lens.y_to_y),
            ("facet", lens.facet_terms[:, :, None]),
            ("plane", lens.plane_terms[:, None, :]),
            ("phasor", phasor),
        ):
            self.register_buffer(name, stacked(value), persistent=False)


class _LensToFacet(_Lens):
    def forward(self, field: Parts) -> Parts:
        field = multiply(field, parts(self.phasor))
        terms = multiply(field, parts(self.plane))  # [R, ny, nx]
        terms = multiply(matmul(terms, parts(self.x)), parts(self.between))
        real, imaginary = multiply(matmul(parts(self.y), terms), parts(self.facet))
        return real.sum(0), imaginary.sum(0)


class _LensToPlane(_Lens):
    def forward(self, field: Parts) -> Parts:
        terms = multiply(field, conjugate(parts(self.facet)))  # [R, fy, fx]
        terms = multiply(matmul(adjoint(parts(self.y)), terms), conjugate(parts(self.between)))
        real, imaginary = multiply(matmul(terms, adjoint(parts(self.x))), conjugate(parts(self.plane)))
        return multiply((real.sum(0), imaginary.sum(0)), parts(self.phasor))


class _PipeBackwards(nn.Module):
    """`PipePropagator.adjoint`."""

    def __init__(self, pipe: PipePropagator) -> None:
        super().__init__()
        y, x = pipe.bases
        self._steps, self._sheared = pipe.steps, pipe.sheared
        self.y_modes: Tensor
        self.x_modes: Tensor
        self.y_singular: Tensor
        self.x_singular: Tensor
        self.cos: Tensor
        self.sin: Tensor
        for name, value in (
            ("y_modes", y.sine_by_parity[:, None]),
            ("x_modes", x.sine_by_parity[None]),
            ("y_singular", y.singular[:, None]),
            ("x_singular", x.singular[None]),
            ("cos", pipe.cos),
            ("sin", pipe.sin),
        ):
            self.register_buffer(name, torch.from_numpy(np.ascontiguousarray(value)), persistent=False)
        self.half_step: Tensor
        self.register_buffer("half_step", stacked(pipe.half), persistent=False)

    def forward(self, field: Parts) -> Parts:
        half = conjugate(parts(self.half_step))
        full = multiply(half, half)
        real, imaginary = (self.y_modes @ part @ self.x_modes.transpose(-1, -2) for part in field)
        modes = multiply((real, imaginary), half)
        for step in range(self._steps):
            if self._sheared:
                modes = self._turned(modes)
            modes = multiply(modes, full if step < self._steps - 1 else half)
        real, imaginary = ((self.y_modes.transpose(-1, -2) @ part @ self.x_modes).sum(dim=(0, 1)) for part in modes)
        return real, imaginary

    def _turned(self, modes: Parts) -> Parts:
        """One step of the shear's coupling, undone: pairs of modes of opposite parity turn into each other."""
        real, imaginary = (self.y_singular.transpose(-1, -2) @ part @ self.x_singular for part in modes)
        # what is (p, q) by parity comes from (1 - p, 1 - q), with i and a sign that is one for equal parities
        sign = torch.tensor([[1.0, -1.0], [-1.0, 1.0]], device=real.device)[:, :, None, None]
        sine = -sign * self.sin
        other_real, other_imaginary = real.flip(0, 1), imaginary.flip(0, 1)
        turned = self.cos * real - sine * other_imaginary, self.cos * imaginary + sine * other_real
        real, imaginary = (self.y_singular @ part @ self.x_singular.transpose(-1, -2) for part in turned)
        return real, imaginary
