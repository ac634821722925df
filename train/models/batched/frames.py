"""Frames of many pages to what the cameras measured on the common grid."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from lightpage.train.models.batched.products import Tables, padded, sizes
from lightpage.train.models.field import FieldRecovery, References, sampled

BLOCK = 16
"""Pixels of a row that a convolution takes for channels: so both axes of the prefilter are one product."""
_NEIGHBOURS = 3
"""Blocks of a row that a block's filtered pixels depend on."""
_WIDE = 2.0**-8
"""Factor on counts of 16 bits, whose largest float16 does not hold."""


class BatchedFrames(nn.Module):
    """Frames to the brightness of the light over the reference's, as squared amplitudes on the common grid.

    Args:
        recovery: of the device; it says how frames are filtered, and where the grid lies on them.
        bits: of a frame's type, 8 or 16.
        dtype: in which all is computed but the sampling.
    """

    def __init__(self, recovery: FieldRecovery, bits: int, dtype: torch.dtype) -> None:
        super().__init__()
        self.recovery, self.dtype = recovery, dtype
        self.unit = 1.0 if bits == 8 else _WIDE
        taps = torch.from_numpy(recovery.grid.prefilter).float()
        self.reach = len(taps) // 2
        weights = torch.zeros(BLOCK, BLOCK, len(taps), _NEIGHBOURS)
        for out in range(BLOCK):
            for number, tap in enumerate(taps):
                block, inner = divmod(out + number - self.reach, BLOCK)
                weights[out, inner, :, block + 1] = taps * tap
        self.weights: Tensor
        self.register_buffer("weights", weights.to(dtype), persistent=False)

    def tables(self, blocks: Tensor, seen: References) -> Tables:
        """Constants of references [2, rows, columns] in blocks of pixels, and what they say.

        Brightness times the squared amplitude is what was sampled times `weight`, and `offset` on it, [1, ny, nx] each
        of either camera; `where` [2, ny, nx, 2] float32 is where it was sampled.
        """
        plain = sampled(self.recovery.filtered(blocks), seen.where)
        squared = seen.amplitude.double() ** 2
        tables = {}
        for camera in (0, 1):
            weight = squared * seen.lit / seen.reference[camera]
            tables[f"weight_{camera}"] = padded(weight / self.unit, -1, -2)[None]
            tables[f"offset_{camera}"] = padded(squared - weight * plain[camera], -1, -2)[None]
            where = seen.where[camera]
            missing = -where.shape[1] % 8, -where.shape[0] % 8
            tables[f"where_{camera}"] = functional.pad(where, (0, 0, 0, missing[0], 0, missing[1]))[None]
        return tables

    def forward(self, frames: Tensor, tables: Tables, camera: int) -> Tensor:
        """Frames [B, H, W] of one camera to brightness times the squared amplitude, [B, ny, nx] of whole multiples."""
        seen = self._filtered(frames)[None].to(torch.float32)
        # pages are channels: the places on the frames are the same for all
        seen = functional.grid_sample(
            seen, tables[f"where_{camera}"], mode="bilinear", padding_mode="border", align_corners=False
        )
        return seen.to(self.dtype).squeeze(0) * tables[f"weight_{camera}"] + tables[f"offset_{camera}"]

    def _filtered(self, frames: Tensor) -> Tensor:
        if self.unit != 1.0:
            frames = frames.to(torch.float32) * self.unit
        binning = self.recovery.binning
        if binning > 1:
            means = functional.avg_pool2d(
                frames.to(self.dtype)[:, None], binning, ceil_mode=True, count_include_pad=False
            )
            return means[:, 0]
        height, width = sizes(frames)[1:]
        missing = -width % BLOCK
        if missing:
            frames = torch.cat([frames, 0 * frames[..., :missing]], -1)
        split = frames.reshape(-1, height, (width + missing) // BLOCK, BLOCK).permute(0, 3, 1, 2).to(self.dtype)
        filtered = functional.conv2d(split, self.weights, padding=(self.reach, _NEIGHBOURS // 2))
        filtered = filtered.permute(0, 2, 3, 1).reshape(-1, height, width + missing)
        return filtered[..., :width] if missing else filtered
