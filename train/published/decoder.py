"""The published decoder: raw frames of one device to the vector p of each symbol."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from lightpage.calibration.samplers import smooth_reference
from lightpage.device.lenses import LENSES
from lightpage.device.profile import Profile
from lightpage.errors import InvalidInputError
from lightpage.recording.frame_pair import FramePair
from lightpage.train.published.localizers import NAMES, Localizer, ModeLocalizer, NoLocalizer, RayLocalizer
from lightpage.train.published.unet import PublishedUNet, samples_for

PARAXIAL = "paraxial"
LENS_CHOICES = (PARAXIAL, *LENSES)


def make_localizer(
    name: str,
    profile: Profile,
    samples: int,
    lenses: str = PARAXIAL,
    quadrature_sign: int = 1,
    *,
    page_moves: bool = False,
) -> Localizer:
    """A published localizer by name.

    Args:
        name: name out of `NAMES`.
        profile: the nominal device.
        samples: samples per symbol and axis.
        lenses: name out of `LENS_CHOICES`, for rays.
        quadrature_sign: sign of the quadrature, for modes, see `ModeLocalizer`.
        page_moves: see `RayLocalizer`.

    Raises:
        InvalidInputError: no such localizer or lens.
    """
    if lenses not in LENS_CHOICES:
        raise InvalidInputError("lenses", repr(lenses), f"one of {', '.join(LENS_CHOICES)}")
    if name == "none":
        return NoLocalizer(profile, samples)
    if name == "mode":
        return ModeLocalizer(profile, samples, quadrature_sign)
    if name == "ray":
        return RayLocalizer(profile, samples, LENSES.get(lenses), page_moves=page_moves)
    raise InvalidInputError("published localizer", repr(name), f"one of {', '.join(NAMES)}")


class PublishedDecoder(nn.Module):
    """Frames over the reference's, localizer, U-Net.

    Args:
        profile: the nominal device.
        references: reference-only frames.
        localizer: see `make_localizer`.
        channels: channels of the U-Net.
        classes: levels that it tells apart as classes; 0 for p itself.
    """

    def __init__(
        self,
        profile: Profile,
        references: FramePair,
        localizer: Localizer,
        channels: tuple[int, int] = (32, 64),
        classes: int = 0,
    ) -> None:
        super().__init__()
        levels = [smooth_reference(frame) for frame in (references.in_phase, references.quadrature)]
        self.references: Tensor
        self.register_buffer("references", torch.from_numpy(np.stack(levels).astype(np.float32)), persistent=False)
        self.localizer = localizer
        unet = PublishedUNet(samples_for(profile.page.symbol_size_px), channels, classes or 2)
        # trains a sixth faster on a CPU; torch does not tell of this argument
        self.unet = unet.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._classes = classes

    def forward(self, frames: Tensor, shift_px: Tensor) -> Tensor:
        """Raw frames [N, 2, H, W] and how far their images have moved [N, 2] to p [N, 2, ny, nx]."""
        return self._p(self.scores(frames, shift_px))

    def scores(self, frames: Tensor, shift_px: Tensor) -> Tensor:
        """Return the U-Net's outputs: p itself, or the logit of each class [N, classes, ny, nx]."""
        with torch.autocast(frames.device.type, enabled=False):
            seen, level = sample_pair(frames.float(), self.references, self.localizer.grid(), shift_px)
        return self._scores(seen, level)

    def read(self, seen: Tensor, level: Tensor) -> Tensor:
        """Samples of the frames [N, 2, h, w] and of the references [N, 2, h, w], counts, to p [N, 2, ny, nx]."""
        return self._p(self._scores(seen, level))

    def _p(self, scores: Tensor) -> Tensor:
        return p_of_classes(scores) if self._classes else scores

    def _scores(self, seen: Tensor, level: Tensor) -> Tensor:
        with torch.autocast(seen.device.type, enabled=False):
            images = self.localizer(over_reference(seen, level))
            places = self.localizer.places.float().permute(2, 0, 1).expand(len(images), -1, -1, -1)
        return torch.as_tensor(self.unet(torch.cat([images, places], dim=1)))


def p_of_classes(logits: Tensor) -> Tensor:
    """The von Mises density with the mean direction of a posterior over M classes, [N, M, ny, nx] to p [N, 2, ny, nx].

    Its concentration is that of the mean resultant's length R, R (2 - R^2) / (1 - R^2) to a few percent (Banerjee et
    al., 2005).
    """
    levels = logits.shape[1]
    angles = torch.arange(levels, device=logits.device) * (2 * math.pi / levels)
    with torch.autocast(logits.device.type, enabled=False):  # of a sure posterior 1 - R^2 would be rounding
        posterior = torch.softmax(logits.float(), dim=1)
        parts = [torch.einsum("nmyx,m->nyx", posterior, wave(angles)) for wave in (torch.cos, torch.sin)]
        mean = torch.stack(parts, dim=1)
        squared = mean.square().sum(1, keepdim=True)
        return torch.as_tensor(mean * (2 - squared) / (1 - squared).clamp(min=1e-5))


def sample_pair(frames: Tensor, references: Tensor, grid: Tensor, shift_px: Tensor) -> tuple[Tensor, Tensor]:
    """Sample both frames of each pair, and the references at the same pixels, bilinearly; zero outside.

    Args:
        frames: [N, 2, H, W].
        references: [2, H, W].
        grid: [2, h, w, 2], (x, y) from -1 to 1 at a frame's edges.
        shift_px: [N, 2], how many pixels (x, y) further on each page's image lies.

    Returns:
        [N, 2, h, w] both.
    """
    width, height = frames.shape[-1], frames.shape[-2]
    by = shift_px * (2 / torch.tensor([width, height], dtype=shift_px.dtype, device=shift_px.device))
    where = grid[None] + by[:, None, None, None]
    both = torch.stack([frames, references.expand_as(frames)], dim=2)
    seen = sample_frames(both.flatten(1, 2), where.repeat_interleave(2, dim=1))
    return seen[:, 0::2], seen[:, 1::2]


def sample_frames(frames: Tensor, grid: Tensor) -> Tensor:
    """Each of the frames [N, C, H, W] at its own places [N, C, h, w, 2], bilinearly, zero outside: [N, C, h, w]."""
    flat = functional.grid_sample(frames.flatten(0, 1)[:, None], grid.flatten(0, 1), align_corners=False)
    return flat.reshape(*frames.shape[:2], *grid.shape[2:4])


def over_reference(seen: Tensor, level: Tensor) -> Tensor:
    """Return a page's frames less the reference, over its amplitude, with a root mean square of 1 a page.

    Args:
        seen, level: counts of the frames and of the references, [N, 2, h, w].
    """
    signal = (seen - level) * torch.rsqrt(level + 1e-6)
    return signal * torch.rsqrt(signal.square().mean(dim=(1, 2, 3), keepdim=True) + 1e-12)
