"""The field on the common grid for many pages: `lightpage.train.models.field` in products and few passes over planes.

Everything is held times the reference's amplitude r, so that no plane is multiplied by it and by its inverse in each
round: L = r (1 + e) is the light at the in-phase camera, L' = r (exp(i turn) + e) at the other one, E = r e the field,
and r^2 times each camera's brightness, |L|^2 and |L'|^2, is what was measured.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from lightpage.calibration.waves.wave_fit import READ_NOISE
from lightpage.train.models.apart import RELAXATION, STIFF, WEIGHT
from lightpage.train.models.batched.products import Tables, padded, sizes, turned_product
from lightpage.train.models.field import MOMENTUM, STEP, FieldRecovery, References
from lightpage.train.models.parts import Parts

_DARK = 2.0**-14
"""Least brightness, so that its quotient with the light is infinite at worst, and no zero over zero."""
_STEEPEST = 60_000.0
"""Largest such quotient: float16 ends at 65,504."""
_EVERY = 4
"""Rows from one to the next of those that tell how much is left of the equations: neighbours tell the same."""
_LOUDER = 16.0
"""Factor on what is left of the equations, whose squares are small numbers for float16."""


class Seen(NamedTuple):
    """Squared amplitudes that both cameras measured, r^2 times brightness, [B, ny, nx] of whole multiples."""

    in_phase: Tensor
    quadrature: Tensor


class BatchedField(nn.Module):
    """Recovers fields as a `FieldRecovery` does: by averaged reflections, by descent, or by the closed root alone.

    The band filter is a product with its Toeplitz matrix along either axis.

    Args:
        recovery: of the device, for cameras that see the same plane.
    """

    def __init__(self, recovery: FieldRecovery) -> None:
        super().__init__()
        self.recovery = recovery
        self.taps: Tensor
        self.register_buffer("taps", torch.from_numpy(recovery.grid.band), persistent=False)
        for name, count in zip(("rows", "columns"), recovery.grid.shape, strict=True):
            self.register_buffer(name, torch.arange(count, dtype=torch.float32), persistent=False)

    def tables(self, seen: References, homodyne: Tensor) -> Tables:
        """Constants of what the references say, and of the turn's cosine and sine [2], float64."""
        cos, sin = homodyne.double().unbind()
        amplitude = padded(seen.amplitude.double(), -1, -2)
        lit = padded(seen.lit.double(), -1, -2)
        inverse = padded(1 / seen.amplitude.double(), -1, -2)
        band_y, band_x = (padded(self._toeplitz(axis), -1, -2) for axis in ("rows", "columns"))
        slope, half = (1 - cos) / sin, turned_product(turned_product(amplitude / 2, band_y), band_x)
        return {
            "band_y": band_y,
            "band_x": band_x,
            "band_rows": padded(band_y[:, : self.recovery.grid.shape[0] : _EVERY], -1),
            "amplitude": amplitude[None],
            "cos_amplitude": (cos * amplitude)[None],
            "sin_amplitude": (sin * amplitude)[None],
            "half_inverse": (inverse / 2)[None],
            "lit": lit[None],
            "slope_amplitude": (slope * amplitude)[None],
            "difference": (inverse / (2 * sin))[None],
            "start": (amplitude - half)[None],
            "curvature": 1 + slope * slope,
            "slope": slope,
            "slope_over": slope / (1 + slope * slope),
            "over": 1 / (1 + slope * slope),
            "relaxed": RELAXATION * amplitude[None],
            "relaxed_cos": RELAXATION * cos * amplitude[None],
            "relaxed_sin": RELAXATION * sin * amplitude[None],
            "arms": (1 - RELAXATION) * (1 + cos) * amplitude[None],
            "arms_sin": (1 - RELAXATION) * sin * amplitude[None],
        }

    def forward(self, seen: Seen, tables: Tables) -> Parts:
        """The field E inside the pipe's band, real and imaginary part, [B, ny, nx] each of whole multiples."""
        field = self._root(seen, tables)
        if self.recovery.reflections:
            return self._reflected(seen, field, tables)
        before = field
        for number in range(self.recovery.rounds):
            ahead = field
            if number:
                real, imaginary = (now + MOMENTUM * (now - was) for now, was in zip(field, before, strict=True))
                ahead = real, imaginary
            pull = self.pull(seen, ahead, tables, READ_NOISE, STEP)
            before, field = field, self._band((ahead[0] + pull[0], ahead[1] + pull[1]), tables)
        return field

    def pull(self, seen: Seen, field: Parts, tables: Tables, floor: Tensor | float, share: float = 1.0) -> Parts:
        """Return the pull of the measurements at a field, times the amplitude: see `lightpage.train.models.field`.

        With r^2 for the floor's unit, a weight's numerator and denominator are both held times r^2.
        """
        at_floor = torch.clamp(floor * tables["amplitude"] * tables["amplitude"], min=_DARK)
        pulls = []
        for measured, light in zip(seen, self._lights(field, tables), strict=True):
            bright = light[0] * light[0] + light[1] * light[1] + at_floor
            weight = (share / 2) * (measured + at_floor) / bright - share / 2
            pulls.append((weight * light[0], weight * light[1]))
        return pulls[0][0] + pulls[1][0], pulls[0][1] + pulls[1][1]

    def innovation(self, seen: Seen, field: Parts, tables: Tables, floor: Tensor | float) -> Parts:
        """See `FieldRecovery.innovation`."""
        real, imaginary = self.pull(seen, field, tables, floor)
        return self._band((tables["lit"] * real, tables["lit"] * imaginary), tables)

    def left(self, seen: Seen, field: Parts, tables: Tables) -> Parts:
        """Return what is left of the two equations inside the band, times the amplitude, in every `_EVERY`-th row."""
        left = []
        for measured, light in zip(seen, self._lights(field, tables), strict=True):
            left.append((measured - light[0] * light[0] - light[1] * light[1]) * tables["half_inverse"])
        thin = [turned_product(turned_product(part, tables["band_rows"]), tables["band_x"]) for part in left]
        return thin[0], thin[1]

    def residual(self, seen: Seen, field: Parts, power: Tensor, tables: Tables) -> Tensor:
        """Power of what is left over the field's `power` [B], as `relative_power` has it, [B] float32."""
        real, imaginary = self.left(seen, field, tables)
        rows = len(range(0, self.recovery.grid.shape[0], _EVERY))
        return self.power((_LOUDER * real, _LOUDER * imaginary), rows) / (power * _LOUDER**2)

    def power(self, field: Parts, rows_shown: int | None = None) -> Tensor:
        """Mean of the squares of both parts over the grid, or so many rows of it, [B] float32: sums are products."""
        ny, nx = self.recovery.grid.shape
        ones = field[0].new_full((sizes(field[0])[2], 8), 1 / nx)
        rows = [(part * part) @ ones for part in field]
        return (rows[0] + rows[1])[..., 0].to(torch.float32).sum(1) * (0.5 / (rows_shown or ny))

    def _lights(self, field: Parts, tables: Tables) -> tuple[Parts, Parts]:
        """L and L' of a field E."""
        real, imaginary = field
        other = real + tables["cos_amplitude"], imaginary + tables["sin_amplitude"]
        return (real + tables["amplitude"], imaginary), other

    def _root(self, seen: Seen, tables: Tables) -> Parts:
        """The closed root nearer to the linear estimate, inside the band.

        L lies on a circle, |L|^2 = r^2 A, and by the difference of the equations on a line, Im L = slope Re L - g.
        """
        a, b = seen
        offset = (a - b) * tables["difference"] + tables["slope_amplitude"]
        root = torch.sqrt(torch.clamp(tables["curvature"] * a - offset * offset, min=0)) * tables["over"]
        middle = tables["slope_over"] * offset
        linear = self._along(a * tables["half_inverse"], tables) + tables["start"]
        real = middle + torch.where(linear < middle, -root, root)
        imaginary = tables["slope"] * real - offset
        return self._band((real - tables["amplitude"], imaginary), tables)

    def _reflected(self, seen: Seen, field: Parts, tables: Tables) -> Parts:
        """See `lightpage.train.models.apart.reflected`.

        With U for twice a camera's light less its state, the state S becomes (2 - relaxation) L + f U, where f is a
        function of what was measured over |U|^2 alone. Kept are F = 2 E, and of a state N = S - (2 - relaxation) r arm:
        then U = F - N + relaxation r arm, N becomes (1 - relaxation / 2) F + f U, and the next F is the band of both N
        and (1 - relaxation) r arm.
        """
        weight = RELAXATION / (2 * STIFF)
        pulling = [torch.clamp(8 * WEIGHT * STIFF * weight**2 * each, min=_DARK) for each in seen]
        stays = 1 - RELAXATION / 2
        states: list[Parts] = []
        reflected = self._lights(field, tables)
        twice = 2 * field[0], 2 * field[1]
        for number in range(self.recovery.reflections):
            if number:
                (a, b), (c, d) = states
                reflected = (
                    (twice[0] - a + tables["relaxed"], twice[1] - b),
                    (twice[0] - c + tables["relaxed_cos"], twice[1] - d + tables["relaxed_sin"]),
                )
            still = stays * twice[0], stays * twice[1]
            states = []
            for (real, imaginary), measured in zip(reflected, pulling, strict=True):
                quotient = torch.clamp(measured / (real * real + imaginary * imaginary), max=_STEEPEST)
                factor = torch.sqrt(quotient + weight**2) + (weight - 1)
                states.append((factor * real + still[0], factor * imaginary + still[1]))
            real = states[0][0] + states[1][0] + tables["arms"]
            imaginary = states[0][1] + states[1][1] + tables["arms_sin"]
            twice = self._band((real, imaginary), tables)
        return 0.5 * twice[0], 0.5 * twice[1]

    def _band(self, planes: Parts, tables: Tables) -> Parts:
        return self._along(planes[0], tables), self._along(planes[1], tables)

    @staticmethod
    def _along(plane: Tensor, tables: Tables) -> Tensor:
        """A plane [B, ny, nx] filtered along both axes."""
        return turned_product(turned_product(plane, tables["band_y"]), tables["band_x"])

    def _toeplitz(self, axis: str) -> Tensor:
        """The band filter along an axis, symmetric [count, count]."""
        places, reach = self.get_buffer(axis), len(self.taps) // 2
        apart = places[:, None] - places
        within = self.taps[(torch.clamp(apart, -reach, reach) + reach).long()]
        return within * (apart.abs() <= reach)
