"""The wave model of a calibrated device as real matrix products, both ways: it trains, and is exported."""

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


class Waves(nn.Module):
    """What `FittedWaves` does, whose matrices it holds; they are constants of the calibrated device.

    The modulator's side has `SAMPLES` a symbol and axis.

    Args:
        profile: the nominal device.
        parameters: [P] fitted (or, for an oracle, true) parameters of the ray twin; the wave model is made from them.
        filled: see `FittedWaves`.
    """

    def __init__(self, profile: Profile, parameters: Real, *, filled: bool = False) -> None:
        super().__init__()
        waves = FittedWaves(profile, parameters, SAMPLES, filled=filled)
        channel = waves.channel
        self._launch = _Lens(channel.launch_lens)
        self._pipe = _Pipe(channel.pipe)
        self._delaunch = _Lens(channel.delaunch_lens)
        self.window: Tensor
        self.at_launch: Tensor
        self.against_reference: Tensor
        self.register_buffer("window", torch.from_numpy(channel.entrance_window), persistent=False)
        self.register_buffer("at_launch", stacked(waves.launch), persistent=False)
        self.register_buffer("against_reference", stacked(waves.against_reference), persistent=False)

    def to_camera(self, page: Tensor) -> Tensor:
        """Field on the modulator [2, ny SAMPLES, nx SAMPLES] to the common grid [2, Gy, Gx], against the reference."""
        real, imaginary = self._launch.to_facet(multiply(parts(page), parts(self.at_launch)))
        exit_field = self._pipe.run((real * self.window, imaginary * self.window), backwards=False)
        return torch.stack(multiply(self._delaunch.to_plane(exit_field), parts(self.against_reference)))

    def to_page(self, field: Tensor) -> Tensor:
        """Field on the common grid [2, Gy, Gx] back to the modulator, by the adjoint."""
        exit_field = self._delaunch.to_facet(multiply(parts(field), conjugate(parts(self.against_reference))))
        real, imaginary = self._pipe.run(exit_field, backwards=True)
        page = self._launch.to_plane((real * self.window, imaginary * self.window))
        return torch.stack(multiply(page, conjugate(parts(self.at_launch))))


class _Lens(nn.Module):
    """`FourierLens`."""

    def __init__(self, lens: FourierLens) -> None:
        super().__init__()
        self.x: Tensor
        self.between: Tensor
        self.y: Tensor
        self.facet: Tensor
        self.plane: Tensor
        for name, value in (
            ("x", lens.x_to_x),
            ("between", lens.y_and_x),
            ("y", lens.y_to_y),
            ("facet", lens.facet_terms[:, :, None]),
            ("plane", lens.plane_terms[:, None, :]),
        ):
            self.register_buffer(name, stacked(value), persistent=False)

    def to_facet(self, field: Parts) -> Parts:
        terms = multiply(field, parts(self.plane))  # [R, ny, nx]
        terms = multiply(matmul(terms, parts(self.x)), parts(self.between))
        real, imaginary = multiply(matmul(parts(self.y), terms), parts(self.facet))
        return real.sum(0), imaginary.sum(0)

    def to_plane(self, field: Parts) -> Parts:
        terms = multiply(field, conjugate(parts(self.facet)))  # [R, fy, fx]
        terms = multiply(matmul(adjoint(parts(self.y)), terms), conjugate(parts(self.between)))
        real, imaginary = multiply(matmul(terms, adjoint(parts(self.x))), conjugate(parts(self.plane)))
        return real.sum(0), imaginary.sum(0)


class _Pipe(nn.Module):
    """`PipePropagator`."""

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

    def run(self, field: Parts, *, backwards: bool) -> Parts:
        half = parts(self.half_step)
        half = conjugate(half) if backwards else half
        full = multiply(half, half)
        real, imaginary = (self.y_modes @ part @ self.x_modes.transpose(-1, -2) for part in field)
        modes = multiply((real, imaginary), half)
        for step in range(self._steps):
            if self._sheared:
                modes = self._turned(modes, -self.sin if backwards else self.sin)
            modes = multiply(modes, full if step < self._steps - 1 else half)
        real, imaginary = ((self.y_modes.transpose(-1, -2) @ part @ self.x_modes).sum(dim=(0, 1)) for part in modes)
        return real, imaginary

    def _turned(self, modes: Parts, sine: Tensor) -> Parts:
        """One step of the shear's coupling: pairs of modes of opposite parity turn into each other."""
        real, imaginary = (self.y_singular.transpose(-1, -2) @ part @ self.x_singular for part in modes)
        # what is (p, q) by parity comes from (1 - p, 1 - q), with i and a sign that is one for equal parities
        sign = torch.tensor([[1.0, -1.0], [-1.0, 1.0]], device=real.device)[:, :, None, None]
        other_real, other_imaginary = real.flip(0, 1), imaginary.flip(0, 1)
        turned = self.cos * real - sign * sine * other_imaginary, self.cos * imaginary + sign * sine * other_real
        real, imaginary = (self.y_singular @ part @ self.x_singular.transpose(-1, -2) for part in turned)
        return real, imaginary
