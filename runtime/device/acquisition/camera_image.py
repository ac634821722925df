"""Processing of one camera's frames before they are read."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.device.profile import StrictTable
from lightpage.progress import warn
from lightpage.recording.exposure import describe, greatest_count, unused_low_bits
from lightpage.recording.layout import frame_type
from lightpage.recording.pixels.black_level import DarkFrame, PixelRepair, without_black
from lightpage.runtime.device.cameras.camera import Camera, Frame

Counts = NDArray[np.unsignedinteger[Any]]


class View(StrictTable):
    """A camera's view of the image: mirrored or not, as behind one more mirror."""

    flip_x: bool = False
    """The camera sees left and right exchanged."""
    flip_y: bool = False
    """The camera sees top and bottom exchanged."""

    def upright(self, pixels: Counts) -> Counts:
        """The frame [row, column] as the modulator has it."""
        return np.ascontiguousarray(pixels[:: -1 if self.flip_y else 1, :: -1 if self.flip_x else 1])


class CameraImage:
    """Turns a camera's frames upright, and mends what is known of their counts.

    Args:
        camera: camera of the frames.
        view: how it sees the image.

    Attributes:
        saturated_share: share of pixels at full scale in the last frame; None before there was one.
    """

    def __init__(self, camera: Camera, view: View) -> None:
        self.camera, self.view = camera, view
        self.saturated_share: float | None = None
        self._unused = 0
        """Lowest bits that the counts leave unused, as frames have shown."""
        self._repair: PixelRepair | None = None
        self._black_level = 0

    def mind(self, dark: DarkFrame) -> None:
        """Mend hot pixels and take the black level off from here on."""
        self._repair, self._black_level = PixelRepair(dark.mean.shape, dark.hot), dark.black_level

    def cleaned(self, frame: Frame) -> Counts:
        """The counts of a frame [row, column], upright, hot pixels mended, the black level taken off."""
        pixels = self.upright(frame)
        if self._repair is None:
            return pixels
        return without_black(self._repair(pixels), self._black_level, self.camera.bit_depth)

    def upright(self, frame: Frame) -> Counts:
        """The counts of a frame [row, column], upright, as they are."""
        bit_depth = self.camera.bit_depth
        pixels = self._to_full_scale(frame.pixels.astype(frame_type(bit_depth), copy=False))
        self.saturated_share = float(np.count_nonzero(pixels >= 2**bit_depth - 1) / pixels.size)
        return self.view.upright(pixels)

    def _to_full_scale(self, pixels: Counts) -> Counts:
        """The counts of a camera that leaves low bits unused, with its greatest one at full scale; it is told once."""
        bit_depth = self.camera.bit_depth
        found = unused_low_bits(pixels, bit_depth)
        if found and not self._unused:
            warn(
                f"{self.camera.name}: {describe(bit_depth, found)}. The greatest of them is taken for full scale; "
                f"better a pixel_format of {bit_depth - found} bits, or less digital gain"
            )
        self._unused = found or self._unused
        if found == 0 or not self._unused:
            return pixels
        clipped = pixels >= greatest_count(bit_depth, self._unused)
        return np.where(clipped, pixels.dtype.type(2**bit_depth - 1), pixels) if clipped.any() else pixels
