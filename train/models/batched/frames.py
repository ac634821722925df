"""Frames of many pages to what the cameras measured on the common grid."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from lightpage.train.models.batched.products import Tables, padded, sizes
from lightpage.train.models.field import FieldRecovery, References

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

        Brightness times the squared amplitude is what was sampled beyond the `beam` times `weight`, and `squared` on
        it, [1, ny, nx] each; `where` [1, ny, nx, 2] float32 is where a camera was sampled, `pixel` [2] a pixel there.
        """
        squared = seen.amplitude.double() ** 2
        tables = {"squared": padded(squared, -1, -2)[None]}
        rows, columns = (count * self.recovery.binning for count in sizes(blocks)[1:])
        tables["where_pixel"] = torch.tensor([2 / columns, 2 / rows])
        for camera in (0, 1):
            beam = blocks[camera : camera + 1] * self.unit
            tables[f"beam_{camera}"] = self._channels(beam) if self.recovery.binning == 1 else beam
            tables[f"weight_{camera}"] = padded(squared * seen.lit / seen.reference[camera] / self.unit, -1, -2)[None]
            where = seen.where[camera]
            missing = -where.shape[1] % 8, -where.shape[0] % 8
            tables[f"where_{camera}"] = functional.pad(where, (0, 0, 0, missing[0], 0, missing[1]))[None]
        return tables

    def forward(self, frames: Tensor, shift: Tensor, tables: Tables, camera: int) -> Tensor:
        """Frames of one camera to brightness times the squared amplitude.

        Args:
            frames: [B, H, W].
            shift: of each page's image against the table's registration, (x, y) in pixels, [B, 2] float32.
            tables: constants.
            camera: 0 for the in-phase one, 1 for the other.

        Returns:
            [B, ny, nx] of whole multiples.
        """
        # sums of numbers alone: no place goes through a product that may be rounded
        places = tables[f"where_{camera}"] + (shift * tables["where_pixel"])[:, None, None]
        seen = self._filtered(frames, tables[f"beam_{camera}"])[:, None].to(torch.float32)
        seen = functional.grid_sample(seen, places, mode="bilinear", padding_mode="border", align_corners=False)
        return seen.to(self.dtype).squeeze(1) * tables[f"weight_{camera}"] + tables["squared"]

    def _filtered(self, frames: Tensor, beam: Tensor) -> Tensor:
        """Frames beyond the reference beam as they are sampled, [B, rows, columns]."""
        if self.unit != 1.0:
            frames = frames.to(torch.float32) * self.unit
        binning = self.recovery.binning
        if binning > 1:
            means = functional.avg_pool2d(
                frames.to(self.dtype)[:, None], binning, ceil_mode=True, count_include_pad=False
            )
            return means[:, 0] - beam
        height, width = sizes(frames)[1:]
        beyond = self._channels(frames).to(self.dtype) - beam
        filtered = functional.conv2d(beyond, self.weights, padding=(self.reach, _NEIGHBOURS // 2))
        filtered = filtered.permute(0, 2, 3, 1).reshape(-1, height, width + -width % BLOCK)
        return filtered[..., :width] if width % BLOCK else filtered

    @staticmethod
    def _channels(frames: Tensor) -> Tensor:
        """Blocks of a row as channels, zeros behind the last pixels: [B, `BLOCK`, rows, columns over `BLOCK`]."""
        height, width = sizes(frames)[1:]
        missing = -width % BLOCK
        if missing:
            frames = torch.cat([frames, 0 * frames[..., :missing]], -1)
        return frames.reshape(-1, height, (width + missing) // BLOCK, BLOCK).permute(0, 3, 1, 2)
