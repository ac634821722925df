"""Two camera frames to one complex field: resampling to the common grid and solving the |E|^2 term.

With the reference-only frame R of a camera and e = E/r, E the signal against a reference of amplitude r,

    A = (I - R_I) / (2 R_I) = Re e + |e|^2 / 2
    B = (Q - R_Q) / (2 R_Q) = Re(e exp(-i turn)) + |e|^2 / 2

where `quadrature_phase` is +90 or -90 degrees, by the sign of Q, plus the quadrature error. The cameras' gains cancel.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from lightpage.calibration.sampling_table import APART, monomial_powers
from lightpage.calibration.waves.wave_fit import READ_NOISE
from lightpage.device.profile import Profile
from lightpage.errors import InvalidInputError
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.pixels.blemishes import UNIT_GAIN
from lightpage.train.models.apart import ROUNDS as ROUNDS_APART
from lightpage.train.models.apart import (
    Cameras,
    CamerasApart,
    CamerasTilted,
    CamerasTogether,
    recovered_linearly,
    reflected,
)
from lightpage.train.models.filters import BLOCK, SeparableFilter
from lightpage.waves.defocus import resampled_taps
from lightpage.waves.grid import GRID_STEP_PX, FieldGrid, field_grid

ROUNDS = 6
"""Steps of descent; beyond these the band filter's ripple adds up."""
STEP = 0.9
"""Along the weighted gradient: the weights bound the curvature by 2, and step times curvature must stay below 2."""
MOMENTUM = 0.5
_CUBIC = 3
_REFERENCE_BLOCK_PX = 4
"""Side of the blocks of pixels whose mean stands for a reference."""
_REFERENCE_STEP = 4
"""Grid samples from one place to the next where those are read."""
_FLOOR = 0.1
"""Least reference, as a share of its mean, that frames are divided by: outside the beam there is nothing to learn."""


class Measured(NamedTuple):
    """Measurements of the cameras on the common grid, [ny, nx] each but the cosine and sine of the turn.

    Attributes:
        a, b: left sides of the two equations, zero where a camera has no reference.
        cos, sin: cosine and sine of the turn between the arms.
        amplitude: the reference's over its mean, by which e becomes E.
        lit: mask: 1 where both cameras have a reference, else 0.
        apart: the defocus of the cameras; None where both see the same plane.
    """

    a: Tensor
    b: Tensor
    cos: Tensor
    sin: Tensor
    amplitude: Tensor
    lit: Tensor
    apart: Cameras | None = None

    def left(self, e: Tensor) -> Tensor:
        """Return the residual of both equations at e, [2, ny, nx], a camera each."""
        in_phase, turned = self._brightness(*self._seen(e), 0.0)
        return torch.stack([self.a + (1 - in_phase) / 2, self.b + (1 - turned) / 2])

    def pull(self, e: Tensor, floor: Tensor | float, share: float = 1.0) -> Tensor:
        """Return the gradient of the measurements' log-likelihood at e, times `share`, [2, ny, nx].

        An equation's variance is that of its camera's photons, |1 + e|^2 or |exp(i turn) + e|^2, and of its
        electronics, the `floor`. The first is also the squared length of its gradient, so a step along the sum needs
        no matrix. What is left of an equation is half of what its brightness lacks, see `left`.
        """
        seen = self._seen(e)
        in_phase, turned = self._brightness(*seen, floor)
        pull_a = share * (self.a + (1 + floor) / 2) / in_phase - share / 2
        pull_b = share * (self.b + (1 + floor) / 2) / turned - share / 2
        if self.apart is not None:
            (real_a, imaginary_a), (real_b, imaginary_b) = (each.unbind() for each in seen)
            by_b = pull_b * (real_b + self.cos), pull_b * (imaginary_b + self.sin)
            return self.apart.gathered(torch.stack([pull_a * (real_a + 1), pull_a * imaginary_a, *by_b]))
        total, (real, imaginary) = pull_a + pull_b, e.unbind()
        return torch.stack([total * real + pull_a + self.cos * pull_b, total * imaginary + self.sin * pull_b])

    @property
    def arms(self) -> Tensor:
        """Phasors of both arms, real and imaginary parts [4, 1, 1]."""
        one = torch.ones_like(self.cos)
        return torch.stack([one, 0 * one, self.cos, self.sin])[:, None, None]

    def _seen(self, e: Tensor) -> tuple[Tensor, Tensor]:
        """The field as either camera sees it, [2, ny, nx] each."""
        if self.apart is None:
            return e, e
        both = self.apart.seen(e)
        return both[:2], both[2:]

    def _brightness(self, e: Tensor, other: Tensor, floor: Tensor | float) -> tuple[Tensor, Tensor]:
        """|1 + e|^2 and |exp(i turn) + other|^2, each with the floor on it, [ny, nx]."""
        real, imaginary = e.unbind()
        real_plus_one = real + 1
        in_phase = real_plus_one * real_plus_one + imaginary * imaginary + floor
        if other is e:
            return in_phase, in_phase + (2 * (self.cos - 1) * real + 2 * self.sin * imaginary)
        real, imaginary = other.unbind()
        return in_phase, (real + self.cos) ** 2 + (imaginary + self.sin) ** 2 + floor

    def in_blocks(self, side: int) -> Measured:
        """Return the measurements on whole blocks of so many samples a side, zeros added at the right and below."""
        ny, nx = self.a.shape
        missing = (0, -nx % side, 0, -ny % side)
        a, b, amplitude, lit = (functional.pad(plane, missing) for plane in (self.a, self.b, self.amplitude, self.lit))
        return self._replace(a=a, b=b, amplitude=amplitude, lit=lit)


class References(NamedTuple):
    """References and registration, evaluated on the common grid.

    Attributes:
        where: places in both frames for grid_sample, [2, ny, nx, 2].
        reference: counts, at least a floor, [2, ny, nx].
        amplitude, lit: see `Measured`.
    """

    where: Tensor
    reference: Tensor
    amplitude: Tensor
    lit: Tensor


class FieldRecovery(nn.Module):
    """Frames and references to the field on the common grid.

    Args:
        profile: the nominal device.
        with_signal_power: whether the frames hold |E|^2; an oracle takes it off beforehand, and the equations are then
            linear.
        rounds: number of steps of descent.
        reflections: rounds of averaged reflections in place of descent; none for descent. Where cameras stand apart,
            reflections serve in any case.
        binning: camera pixels along each axis whose mean is sampled; one filters the frames first instead, which takes
            longer and loses less.
        grid: the common grid, where it is not the usual one.
        corrected: whether interpolation is corrected for places between pixels, see `lightpage.waves.resampling`.

    Raises:
        InvalidInputError: a binning that the blocks of the reference are no multiple of.
    """

    def __init__(
        self,
        profile: Profile,
        *,
        with_signal_power: bool = True,
        rounds: int = ROUNDS,
        reflections: int = 0,
        binning: int = 1,
        grid: FieldGrid | None = None,
        corrected: bool = False,
    ) -> None:
        super().__init__()
        if binning < 1 or _REFERENCE_BLOCK_PX % binning:
            raise InvalidInputError("binning, camera pixels", binning, f"a divisor of {_REFERENCE_BLOCK_PX}")
        self.with_signal_power, self.binning = with_signal_power, binning
        self.rounds, self.reflections = rounds, reflections
        grid = grid or field_grid(profile)
        self.grid = grid
        self.rows_px, self.columns_px = profile.frame_shape
        # the outer pixels' centres, where blocks' outer edges lie at -1 and 1
        blocked = [(count, -(-count // binning) * binning) for count in profile.frame_shape]
        self._size = [extent for _, extent in reversed(blocked)]
        self._edge = min(min(1 - 1 / extent, (2 * count - 1) / extent - 1) for count, extent in blocked)
        corner = profile.corner_m
        self.prefilter = SeparableFilter(grid.resampling.prefilter if corrected else grid.prefilter)
        self.correction = SeparableFilter(grid.resampling.correction) if corrected else None
        self.band = SeparableFilter(grid.band)
        self.u: Tensor
        self.v: Tensor
        for power_name, axis in (("u", grid.x_m), ("v", grid.y_m)):
            powers = np.stack([(axis / corner) ** power for power in range(_CUBIC + 1)])
            self.register_buffer(power_name, torch.tensor(powers, dtype=torch.float32))
        self.to_taps: Tensor
        to_taps = resampled_taps(grid.step_px / GRID_STEP_PX)
        self.register_buffer("to_taps", torch.tensor(to_taps, dtype=torch.float32), persistent=False)

    def forward(self, *seen: Tensor) -> tuple[Tensor, Tensor]:
        """Recover the field; arguments as for `measure`, results as of `solve`."""
        return self.solve(self.measure(*seen))

    def measure(
        self,
        in_phase: Tensor,
        quadrature: Tensor,
        reference_in_phase: Tensor,
        reference_quadrature: Tensor,
        registration: Tensor,
        homodyne: Tensor,
        *apart: Tensor,
    ) -> Measured:
        """Measure the field on the common grid by both cameras.

        Args:
            in_phase, quadrature: raw frames [H, W], any number type.
            reference_in_phase, reference_quadrature: reference-only frames [H, W], counts.
            registration: [2, 2, 10], pixel (column, row) of each camera as a cubic in the grid's (x, y), each over
                the page's corner radius.
            homodyne: [2], cosine and sine of the turn between the two arms.
            apart: those of `lightpage.calibration.sampling_table.cameras_apart`, on the usual grid, that
                `apart_inputs` names.
        """
        blocks = self.in_blocks(reference_in_phase, reference_quadrature)
        return self.measure_against(
            blocks, self.references(blocks, registration), in_phase, quadrature, homodyne, *apart
        )

    def measure_against(
        self,
        blocks: Tensor,
        references: References,
        in_phase: Tensor,
        quadrature: Tensor,
        homodyne: Tensor,
        *apart: Tensor,
        gains: Tensor | None = None,
    ) -> Measured:
        """Measure the field against references that are known on the common grid already.

        Args:
            blocks: references in blocks, [2, rows, columns].
            references: the same on the common grid.
            in_phase, quadrature, homodyne, apart: see `measure`.
            gains: see `lightpage.recording.pixels.blemishes.Blemishes`, [2, H, W]; without binning. None for pixels
                without blemishes.
        """
        frames = self.in_blocks(in_phase, quadrature)
        if gains is None:
            beyond = frames - blocks
        else:
            gains = gains.to(torch.float32)
            beyond = (frames * (gains / UNIT_GAIN) - blocks) * torch.clamp(gains, max=1)
        a, b = references.lit * self._resampled(self.filtered(beyond), references.where) / (2 * references.reference)
        return Measured(a, b, homodyne[0], homodyne[1], references.amplitude, references.lit, self.cameras(*apart))

    def cameras(self, *apart: Tensor) -> Cameras | None:
        """Cameras that stand apart, by what `measure` takes; None where both see the same plane."""
        if not apart:
            return None
        taps, *tilted = apart
        taps = taps @ self.to_taps.T
        if not tilted:
            return CamerasApart.of(taps)
        beside, tilt = tilted
        along = tilt[0] * self.u[1] + (tilt[1] * self.v[1])[:, None]
        return CamerasTilted.of(taps, beside @ self.to_taps.T, along)

    def in_blocks(self, in_phase: Tensor, quadrature: Tensor) -> Tensor:
        """Two frames in blocks of pixels, [2, rows, columns]."""
        return _block_means(_stacked(in_phase, quadrature), self.binning)

    def filtered(self, blocks: Tensor) -> Tensor:
        """Return the frames as they are sampled, [2, rows, columns]."""
        return torch.as_tensor(self.prefilter(blocks)) if self.binning == 1 else blocks

    def references(self, blocks: Tensor, registration: Tensor) -> References:
        """Evaluate the references on the common grid, both given in blocks."""
        where = self._where(registration, self.binning)
        reference = self._reference(blocks, registration)
        floor = _FLOOR * blocks.mean(dim=(1, 2))[:, None, None]
        across, down = where.unbind(-1)
        seen = (across.abs() <= self._edge) & (down.abs() <= self._edge) & (reference > floor)
        lit = (seen[0] & seen[1]).to(torch.float32)
        reference = torch.maximum(reference, floor)
        amplitude = torch.sqrt(reference[0])
        mean = amplitude.mean(1).mean(0)  # ONNX Runtime's mean of millions of elements at once is inaccurate
        return References(where, reference, amplitude / mean, lit)

    def solve(self, measured: Measured) -> tuple[Tensor, Tensor]:
        """Solve what was measured.

        Returns:
            field: [2, ny, nx], real and imaginary part of E over the reference amplitude's mean on the grid.
            residual: [2, ny, nx], what is left of the two equations inside the pipe's band, over the mean reference
                amplitude; large against the field when the frames do not belong to this calibration.
        """
        ny, nx = self.grid.shape
        blocks = measured.in_blocks(BLOCK)
        # zero outside the grid, as the amplitude is
        inverse_amplitude = functional.pad(1 / measured.amplitude, (0, -nx % BLOCK, 0, -ny % BLOCK))
        e = self._solve(blocks, inverse_amplitude)
        residual = self.band(blocks.left(e) * blocks.amplitude)
        return (e * blocks.amplitude)[:, :ny, :nx], residual[:, :ny, :nx]

    def solve_samples(self, measured: Measured) -> tuple[Tensor, Tensor]:
        """Solve each sample of what was measured alone, for waves that pass the pipe's band only.

        Where the cameras stand apart, samples are solved together, see `solve`.

        Returns:
            See `solve`; neither is limited to the pipe's band.
        """
        if measured.apart is not None:
            return self.solve(measured)
        root = self._nearest_root(measured, 1 / measured.amplitude)
        return root * measured.amplitude, measured.left(root) * measured.amplitude

    def innovation(self, measured: Measured, field: Tensor, floor: Tensor | float) -> Tensor:
        """Return the change of a predicted field that the measurements ask for.

        Args:
            measured: measurements of the frames.
            field: predicted E [2, ny, nx], as `solve` returns it.
            floor: see `Measured.pull`.

        Returns:
            [2, ny, nx], inside the pipe's band; the sum over both equations, each weighted by what it tells.
        """
        pull = measured.lit * measured.pull(field / measured.amplitude, floor)
        return torch.as_tensor(self.band(pull * measured.amplitude))

    def _solve(self, measured: Measured, inverse_amplitude: Tensor) -> Tensor:
        """Solve the two equations for e, [2, ny, nx]; `inverse_amplitude` is zero where the amplitude is, [ny, nx].

        Each sample alone is a quadratic with two roots, which meet where the signal outshines the reference. So: the
        closed root nearer to the linear estimate; from there averaged reflections (`reflected`), or descent with
        momentum towards the most likely field in the pipe's band. Where the cameras stand apart, descent gets stuck.
        """
        a, b, _, _, amplitude, _, apart = measured
        if apart is not None and not self.with_signal_power:
            both = torch.stack([a, b])
            return recovered_linearly(apart, both, measured.arms, amplitude, inverse_amplitude, self.band)
        if not self.with_signal_power:
            return self._linear(measured, inverse_amplitude)
        root = self._nearest_root(measured, inverse_amplitude)
        before = estimate = self.band(root * amplitude) * inverse_amplitude
        if apart is not None or self.reflections:
            cameras, rounds = (CamerasTogether(), self.reflections) if apart is None else (apart, ROUNDS_APART)
            brightness = 1 + 2 * torch.stack([a, b])
            light = brightness, measured.arms, amplitude, inverse_amplitude
            return reflected(cameras, rounds, estimate, *light, self.band)
        for _ in range(self.rounds):
            ahead = estimate + MOMENTUM * (estimate - before)
            step = measured.pull(ahead, READ_NOISE, STEP)
            before, estimate = estimate, self.band((ahead + step) * amplitude) * inverse_amplitude
        return torch.as_tensor(estimate)

    def _linear(self, measured: Measured, inverse_amplitude: Tensor) -> Tensor:
        """Solve the equations without |e|^2 for e in the pipe's band, [2, ny, nx]."""
        a, b, cos, sin, amplitude, *_ = measured
        return torch.as_tensor(self.band(torch.stack([a, (b - cos * a) / sin]) * amplitude) * inverse_amplitude)

    def _nearest_root(self, measured: Measured, inverse_amplitude: Tensor) -> Tensor:
        """Solve each sample alone for e, [2, ny, nx]: of two roots, the one nearer to the linear field."""
        a, b, cos, sin, *_ = measured
        start = self._linear(measured, inverse_amplitude)
        # Im e = slope Re e - offset, from the difference of the equations; then a quadratic in Re e
        slope, offset = (1 - cos) / sin, (a - b) / sin
        quadratic = 1 + slope * slope
        linear = 1 - slope * offset
        discriminant = linear * linear - quadratic * (offset * offset - 2 * a)
        middle = -linear / quadratic
        root = torch.sqrt(torch.clamp(discriminant, min=0)) / quadratic
        real = middle + torch.where(start[0] < middle, -root, root)
        return torch.stack([real, slope * real - offset])

    def _where(self, registration: Tensor, side: int, step: int = 1) -> Tensor:
        """Return the places of every `step`-th grid sample in frames of blocks, [2, ny, nx, 2] for grid_sample.

        From -1 to 1 between the outer edges of the blocks.
        """
        size = registration.new_tensor([-(-count // side) * side for count in (self.columns_px, self.rows_px)])
        cubic = 2 * registration / size[:, None]
        centre = (1 / size - 1)[:, None].expand(2, 2, 1)
        cubic = torch.cat([cubic[..., :1] + centre, cubic[..., 1:], torch.zeros_like(cubic[..., :1])], dim=-1)
        powers = monomial_powers()
        absent = len(powers)
        table = [
            [powers.index((i, j)) if (i, j) in powers else absent for i in range(_CUBIC + 1)] for j in range(_CUBIC + 1)
        ]
        by_power = cubic[..., torch.tensor(table, device=cubic.device)]  # [2, 2, powers of y, powers of x]
        along_rows = (by_power @ self.u[:, ::step]).permute(0, 2, 3, 1)
        places = self.v[:, ::step].T @ along_rows.flatten(2)
        return places.reshape(*places.shape[:2], -1, 2)

    def _resampled(self, images: Tensor, where: Tensor) -> Tensor:
        """Filtered frames [2, rows, columns] at the places [2, ny, nx, 2], [2, ny, nx]."""
        samples = sampled(images, where)
        if self.correction is None:
            return samples
        # counted in pixels; what lies beyond the frame has no reference
        beyond_x, beyond_y = (
            torch.remainder((place + 1) * (extent / 2) - 0.5, 1)
            for place, extent in zip(where.unbind(-1), self._size, strict=True)
        )
        samples = samples + beyond_x * (1 - beyond_x) * self.correction.along_rows(samples)
        return samples + beyond_y * (1 - beyond_y) * self.correction.along_columns(samples)

    def _reference(self, references: Tensor, registration: Tensor) -> Tensor:
        """Binned references on the grid, [2, ny, nx]: beams are smooth, so few places are looked at."""
        coarse = self._where(registration, _REFERENCE_BLOCK_PX, _REFERENCE_STEP)
        blocks = _block_means(references, _REFERENCE_BLOCK_PX // self.binning)
        seen = sampled(blocks, coarse)
        ny, nx = self.grid.shape
        rows = _interpolated(seen.transpose(1, 2), ny).transpose(1, 2)
        return _interpolated(rows, nx)


def _stacked(in_phase: Tensor, quadrature: Tensor) -> Tensor:
    """Two frames as one [2, H, W] of float32: each alone, since TensorRT does nothing with integers but this."""
    return torch.stack([in_phase.to(torch.float32), quadrature.to(torch.float32)])


def _block_means(images: Tensor, side: int) -> Tensor:
    """Means of blocks of pixels of images [2, H, W]."""
    if side == 1:
        return images
    return functional.avg_pool2d(images[:, None], side, ceil_mode=True, count_include_pad=False)[:, 0]


def sampled(images: Tensor, where: Tensor) -> Tensor:
    """Images [2, H, W] interpolated where `FieldRecovery._where` says, [2, ny, nx]."""
    seen = functional.grid_sample(images[:, None], where, mode="bilinear", padding_mode="border", align_corners=False)
    return seen[:, 0]


def _interpolated(coarse: Tensor, count: int) -> Tensor:
    """Every `_REFERENCE_STEP`-th of so many samples [C, H, coarse] to all of them, linearly; constant behind the last.

    By blocks, as a `SeparableFilter` works.
    """
    blocks, each = -(-count // BLOCK), BLOCK // _REFERENCE_STEP
    shares = np.stack(
        [np.interp(np.arange(BLOCK) / _REFERENCE_STEP, np.arange(each + 1), unit) for unit in np.eye(each + 1)]
    )
    weights = torch.tensor(shares.T, dtype=coarse.dtype, device=coarse.device)[:, None, None]
    channels, rows, known = coarse.shape
    behind = coarse[..., -1:].expand(-1, -1, blocks * each + 1 - known)
    split = functional.conv2d(torch.cat([coarse, behind], dim=-1)[:, None], weights, stride=(1, each))
    return split.permute(0, 2, 3, 1).reshape(channels, rows, blocks * BLOCK)[..., :count]


def relative_power(residual: Tensor, field: Tensor) -> Tensor:
    """Power of the residual over that of the field, scalar."""
    return (residual * residual).mean() / (field * field).mean()


class TorchFieldSolver:
    """`FieldRecovery` behind the numpy interface that registration takes (`FieldSolver`); it computes where that is."""

    def __init__(self, recovery: FieldRecovery) -> None:
        self._recovery = recovery

    def __call__(
        self,
        pair: FramePair,
        references: FramePair,
        registration: NDArray[np.float32],
        homodyne: NDArray[np.float32],
        apart: Mapping[str, NDArray[np.float32]],
    ) -> tuple[NDArray[np.complex64], NDArray[np.float32]]:
        """See `lightpage.calibration.interfaces.FieldSolver`."""
        frames = (pair.in_phase, pair.quadrature, references.in_phase, references.quadrature)
        device = next(self._recovery.buffers()).device
        table = registration, homodyne, *(apart[name] for name in APART if name in apart)
        seen = (torch.from_numpy(each.astype(np.float32)).to(device) for each in (*frames, *table))
        exact = torch.backends.cudnn.flags(enabled=True, allow_tf32=False)  # 10 bits would be seen
        with torch.no_grad(), exact:
            field, residual = self._recovery(*seen)
        real, imaginary = field.cpu().numpy()
        return np.asarray(real + 1j * imaginary, dtype=np.complex64), residual.cpu().numpy()
