"""The published localizers, none, by modes and by rays: samples of both frames to images that lie as the page does."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd import forward_ad

from lightpage.device.lenses import LensPrescription
from lightpage.device.profile import Profile
from lightpage.train.models.parts import adjoint, matmul, multiply, parts, stacked
from lightpage.train.published.rays import RayTracer, Traced
from lightpage.waves.geometry import WaveGeometry, cells_for, mode_detuning
from lightpage.waves.lens import modes_of_plane

AFFINE_START = (0.98, 0.95)
"""Page over camera along x and y, roughly: where each camera's affine starts."""
NAMES = ("none", "mode", "ray")
TRACED_ANEW_RAD = 1e-3
"""Change of the pipe's angle in training after which rays are traced anew. Until then their places are linear in it: at
full size they err by 0.01 camera pixel at most, but for one ray in two thousand, which meets other walls."""
TRACED_ANEW_SAMPLES = 1.0
"""The same for places on the page, where they are trained: rays at the edge of a zone meet other walls."""
_FAR = 10.0
"""Place in page half extents: off every camera, where samples are zero."""


class Registration(nn.Module):
    """A trainable affine for each camera, from the page's coordinates to the frame's: both run from -1 to 1."""

    def __init__(self) -> None:
        super().__init__()
        self.matrix = nn.Parameter(torch.diag(torch.tensor(AFFINE_START)).expand(2, 2, 2).clone())
        self.offset = nn.Parameter(torch.zeros(2, 2))

    def begin(self, scales: tuple[float, float]) -> None:
        """Begin with other scales along x and y, page over camera."""
        self.matrix.data = torch.diag(torch.tensor(scales)).to(self.matrix).expand(2, 2, 2).clone()

    def forward(self, places: Tensor) -> Tensor:
        """Places [h, w, 2] (x, y) to those in each frame, [2, h, w, 2]."""
        return torch.einsum("cij,hwj->chwi", self.matrix, places) + self.offset[:, None, None]


def page_places(shape: tuple[int, int]) -> Tensor:
    """Centres of h x w samples that cover the page, (x, y) from -1 to 1 at its edges, [h, w, 2]."""
    y, x = ((torch.arange(count, dtype=torch.float64) * 2 + 1) / count - 1 for count in shape)
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)


class Localizer(nn.Module):
    """Base of the three localizers: the samples' places on the page, and the registration of each camera.

    Args:
        profile: the nominal device.
        samples: samples per symbol and axis.
    """

    def __init__(self, profile: Profile, samples: int) -> None:
        super().__init__()
        rows, columns = profile.page_shape
        self.places: Tensor
        self.register_buffer("places", page_places((rows * samples, columns * samples)), persistent=False)
        self.registration = Registration()

    def grid(self) -> Tensor:
        """Return the places of the samples in both frames, [2, h, w, 2], (x, y) from -1 to 1 at their edges."""
        return torch.as_tensor(self.registration(self.places.float()))

    def forward(self, seen: Tensor) -> Tensor:
        """Samples of both frames [N, 2, h, w], over the reference's, to two images of the page, [N, 2, h, w]."""
        return seen


class NoLocalizer(Localizer):
    """Every sample is taken where it would lie without a pipe."""


class ModeLocalizer(Localizer):
    """Undoes a square pipe of nominal measures by its sine modes (supplement S9).

    Both frames are sampled evenly, weighed and offset by a 1x1 convolution each, and put together to a field, which
    goes back through de-launch lens, pipe and launch lens: matrix products along the axes, and one phase for each mode.

    Args:
        profile: the nominal device.
        samples: samples per symbol and axis.
        quadrature_sign: +1 where the quadrature camera shows the sine of the phase, -1 where its opposite.
    """

    def __init__(self, profile: Profile, samples: int, quadrature_sign: int = 1) -> None:
        super().__init__(profile, samples)
        self.weight = nn.Parameter(torch.ones(2, 1, 1))
        self.bias = nn.Parameter(torch.zeros(2, 1, 1))
        self._sign = float(quadrature_sign)
        geometry = WaveGeometry(
            wavelength_m=profile.light.wavelength_m,
            focal_length_m=profile.lens.focal_length_m,
            pipe_length_m=profile.pipe.length_m,
            pipe_width_m=profile.pipe.width_m,
            refractive_index=profile.pipe.refractive_index,
        )
        half = np.array([profile.page_width_m, profile.page_height_m]) / 2
        axes = [half[0] * self.places[0, :, 0].numpy(), half[1] * self.places[:, 0, 1].numpy()]
        cells_y, cells_x = cells_for(geometry, axes[0], axes[1], half[0], half[1])
        x, y = (modes_of_plane(geometry, axis, n) for axis, n in zip(axes, (cells_x, cells_y), strict=True))
        detuning = mode_detuning(geometry, np.arange(1.0, cells_y)[:, None], np.arange(1.0, cells_x)[None, :])
        phase = -geometry.pipe_length_m * detuning
        self.x: Tensor
        self.y: Tensor
        self.pipe: Tensor
        for name, value in (("x", x.T), ("y", y), ("pipe", np.exp(1j * phase))):
            self.register_buffer(name, stacked(value), persistent=False)

    def forward(self, seen: Tensor) -> Tensor:
        """Samples of both frames [N, 2, h, w] to real and imaginary part of the field on the modulator."""
        seen = seen * self.weight + self.bias
        x, y = parts(self.x), parts(self.y)
        modes = matmul(matmul(y, (seen[:, 0], self._sign * seen[:, 1])), x)
        modes = multiply(modes, parts(self.pipe))
        return torch.stack(matmul(matmul(adjoint(y), modes), adjoint(x)), dim=1)


class PageAffine(nn.Module):
    """A trainable affine of the page against the pipe, in page half extents; nothing moves at first.

    Walls turn the page's image over, so no affine of a camera stands for a page beside the pipe's axis.
    """

    def __init__(self) -> None:
        super().__init__()
        self.matrix = nn.Parameter(torch.eye(2))
        self.offset = nn.Parameter(torch.zeros(2))

    def forward(self, places: Tensor) -> Tensor:
        """Return where places [h, w, 2] of the page stand."""
        return torch.einsum("ij,hwj->hwi", self.matrix, places) + self.offset


class _Landed(NamedTuple):
    """Places of the samples' rays about one angle of the pipe.

    Attributes:
        angle: the angle, radians.
        entered: places on the page, in its half extents, [h, w, 2].
        places: places on the camera plane in page half extents, [h, w, 2] float32; a lost ray's is off every camera.
        slopes: their change with the angle, 1/rad, and with the place on the page along x and y where that is trained,
            [h, w, 2] float32.
    """

    angle: float
    entered: Tensor
    places: Tensor
    slopes: list[Tensor]


class RayLocalizer(Localizer):
    """Samples the frames where a ray from each sample of the page lands (supplement S10).

    Affine of each camera and the pipe's angle are trained; the sampling grid is a constant once they are. A trace takes
    ten times as long as the rest of a step on a GPU, so rays are traced where the angle has moved by more than
    `TRACED_ANEW_RAD`, or the page by more than a sample, and at every other angle and place where nothing is trained.

    Args:
        profile: the nominal device.
        samples: samples per symbol and axis.
        lens: prescription of both lenses; ideal ones if left out.
        page_moves: whether an affine of the page is trained too, not the authors'.
    """

    def __init__(
        self, profile: Profile, samples: int, lens: LensPrescription | None = None, *, page_moves: bool = False
    ) -> None:
        super().__init__(profile, samples)
        self.tracer = RayTracer(profile, lens)
        self.angle = nn.Parameter(torch.tensor(np.deg2rad(profile.pipe.angle_deg), dtype=torch.float32))
        self.page = PageAffine() if page_moves else None
        self._half = (profile.page_width_m / 2, profile.page_height_m / 2)
        self._landed: _Landed | None = None

    def grid(self) -> Tensor:
        """Return the places of the samples in both frames; a ray that the pipe loses lies outside them."""
        entered = self.places if self.page is None else self.page(self.places.float())
        angle, known = float(self.angle.detach()), self._landed
        if known is None or known.places.device != self.places.device or self._stale(known, angle, entered.detach()):
            known = self._landed = self._trace(angle, entered.detach())
        landed = known.places + (self.angle - known.angle) * known.slopes[0]
        for axis, slope in enumerate(known.slopes[1:]):
            landed = landed + (entered - known.entered)[..., axis, None] * slope
        return torch.as_tensor(self.registration(landed))

    def _stale(self, known: _Landed, angle: float, entered: Tensor) -> bool:
        """Return whether rays are to be traced anew, as they are too where a value is NaN."""
        sample = 2 / max(self.places.shape)  # in page half extents
        angle_rad, samples = (TRACED_ANEW_RAD, TRACED_ANEW_SAMPLES) if self.training else (0.0, 0.0)
        moved = 0.0 if self.page is None else float((entered - known.entered).abs().max())
        return not (abs(angle - known.angle) <= angle_rad and moved <= samples * sample)

    @torch.inference_mode(mode=False)  # forward derivatives need it off
    @torch.no_grad()
    def _trace(self, angle: float, entered: Tensor) -> _Landed:
        half = torch.tensor(self._half, dtype=torch.float64, device=self.places.device)
        at = torch.tensor(angle, dtype=torch.float64, device=self.places.device)
        points = (entered.double() * half).reshape(-1, 2)
        tangents: list[tuple[Tensor | None, Tensor | None]] = [(None, torch.ones_like(at))]
        if self.page is not None:
            tangents += [(axis.expand_as(points), None) for axis in torch.diag(half)]
        found = [self._change(points, at, *along) for along in tangents]
        (traced, _), shape = found[0], self.places.shape
        valid = traced.valid[:, None]
        landed = torch.where(valid, traced.places / half, _FAR).reshape(shape).float()
        slopes = [torch.where(valid, slope / half, 0.0).reshape(shape).float() for _, slope in found]
        return _Landed(angle, entered, landed, slopes)

    def _change(
        self, points: Tensor, angle: Tensor, along_points: Tensor | None, along_angle: Tensor | None
    ) -> tuple[Traced, Tensor]:
        """Rays, and the change of their places along tangents of points and angle; what has none stays."""
        with forward_ad.dual_level():
            traced = self.tracer(_dual(points, along_points), _dual(angle, along_angle))
            places, slope = forward_ad.unpack_dual(traced.places)  # type: ignore[no-untyped-call]
        slope = torch.zeros_like(places) if slope is None else slope  # of a pipe that no ray meets
        return traced._replace(places=places), slope


def _dual(value: Tensor, tangent: Tensor | None) -> Tensor:
    dual: Tensor = value if tangent is None else forward_ad.make_dual(value, tangent)  # type: ignore[no-untyped-call]
    return dual
