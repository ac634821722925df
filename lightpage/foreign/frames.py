"""Frames of both cameras in arrays of other programs: which page lies where, set upright, and checked."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import FrameError, InvalidInputError
from lightpage.foreign.array import ForeignArray, spread

Counts = NDArray[np.unsignedinteger[Any]]
Flip = Literal["", "x", "y", "xy"]
Turn = Literal[0, 90, 180, 270]

_BLOCK_BYTES = 1 << 26
"""Read at once: pages that lie scattered are read many together, and two blocks are kept for each array."""
_BLOCKS = 2
_MOST_COUNT = 65_535


class Arrangement(StrEnum):
    """Ways in which one array holds the frames of both cameras."""

    INTERLEAVED = "interleaved"
    """In-phase and quadrature frame take turns; of four axes, the two cameras are the inner one."""
    HALVES = "halves"
    """All in-phase frames come first; of four axes, the two cameras are the outer one."""
    SIDE_BY_SIDE = "side-by-side"
    """The left half of a picture is the in-phase frame."""
    ABOVE = "above"
    """The upper half of a picture is the in-phase frame."""


@dataclass(frozen=True)
class Upright:
    """A way of setting a frame upright: it is flipped first, then turned.

    Attributes:
        flip: ``x`` exchanges left and right, ``y`` top and bottom, ``xy`` both.
        turn_deg: clockwise.
    """

    flip: Flip = ""
    turn_deg: Turn = 0

    def before(self, shape: tuple[int, int]) -> tuple[int, int]:
        """Return rows and columns of a frame that has the shape afterwards."""
        return shape if self.turn_deg % 180 == 0 else shape[::-1]

    def __call__(self, frame: NDArray[Any]) -> NDArray[Any]:
        """Return a frame [row, column] set upright."""
        frame = frame[:: -1 if "y" in self.flip else 1, :: -1 if "x" in self.flip else 1]
        return np.ascontiguousarray(np.rot90(frame, -self.turn_deg // 90))


class Pages:
    """Pages [row, column] of an array, by number.

    Args:
        array: of two axes for a single page, three, or four.
        shape: rows and columns of a page.
        what: a page is, for errors: frames or symbols, and of which profile.
        together: whether pages that lie together are read at once, for whoever wants all of them.

    Raises:
        InvalidInputError: an array of other axes.
    """

    def __init__(self, array: ForeignArray, shape: tuple[int, int], what: str, *, together: bool = True) -> None:
        self.subject, self._array, self.shape = array.subject, array, shape
        self._kept: OrderedDict[int, NDArray[Any]] = OrderedDict()
        whole = array.shape
        if 0 in whole or not 2 <= len(whole) <= 4:
            raise self._other(what)
        if (axis := first_axis_of_pages(array, shape)) is None:
            raise self._other(what)
        self._axis, self.outer = axis, whole[2:] if axis else whole[:-2]
        self.count = math.prod(self.outer)
        self._outermost = self.outer[0] if self.outer else 1
        self._step = self._pages_at_once() if together else 1

    def _pages_at_once(self) -> int:
        """Return how many entries of the outermost axis of pages are read together."""
        inner = math.prod(self._array.shape) // self._outermost * self._array.dtype.itemsize
        return max(1, min(self._outermost, _BLOCK_BYTES // max(1, inner)))

    def _other(self, what: str) -> InvalidInputError:
        rows, columns = self.shape
        got, expected = f"shape {self._array.shape}", f"{what} of {rows} x {columns} along the last or first two axes"
        if (columns, rows) in (self._array.shape[-2:], self._array.shape[:2]):
            got += ", rows and columns exchanged"
            if "frames" in what:
                expected += ": --turn-in-phase and --turn-quadrature turn them by 90 degrees"
        return InvalidInputError(self.subject, got, expected)

    def page(self, number: int) -> NDArray[Any]:
        """Return a page as it is stored.

        Raises:
            InvalidInputError, StorageError, SurroundingsError: it cannot be read.
        """
        outer, inner = divmod(number, self.count // self._outermost)
        block = self._block(outer // self._step)
        within = outer % self._step
        if self._axis == 0:
            page: NDArray[Any] = block[within].reshape(-1, *self.shape)[inner] if self.outer else block
            return page
        return block[:, :, within].reshape(*self.shape, -1)[:, :, inner]

    def _block(self, number: int) -> NDArray[Any]:
        if number not in self._kept:
            start = number * self._step
            stop = min(start + self._step, self._outermost)
            axis = self._axis if self.outer else 0
            self._kept[number] = self._array.take(axis, start, stop if self.outer else self._array.shape[0])
            if len(self._kept) > _BLOCKS:
                self._kept.popitem(last=False)
        self._kept.move_to_end(number)
        return self._kept[number]


class Frames:
    """The frames of one camera, as whole counts, upright.

    Args:
        pages: that hold them.
        numbers: of the pages that are this camera's frames.
        cut: part of a page that is the frame.
        upright: how it is set upright.
    """

    def __init__(self, pages: Pages, numbers: range, cut: tuple[slice, slice], upright: Upright) -> None:
        self._pages, self._numbers, self._cut, self._upright = pages, numbers, cut, upright
        self.subject = pages.subject
        self.shift = 0
        """Bits that are not used below a count: frames are told without them."""

    def __len__(self) -> int:
        return len(self._numbers)

    def frame(self, page: int) -> Counts:
        """Return the frame of a page, [row, column].

        Raises:
            FrameError: values that are no counts.
            InvalidInputError, StorageError, SurroundingsError: it cannot be read.
        """
        number = self._numbers[page]
        data = whole_counts(self._pages.page(number)[self._cut], f"{self.subject}: frame {number}")
        if self.shift:
            if int(np.bitwise_or.reduce(data, axis=None)) & ((1 << self.shift) - 1):
                expected = f"multiples of {1 << self.shift}, as in the frames before, or --bit-depth"
                raise FrameError(f"{self.subject}: frame {number}", "a count between them", expected)
            data = (data >> self.shift).astype(data.dtype)
        return self._upright(data)

    def sample(self, most: int) -> Iterator[Counts]:
        """Return an iterator over some frames from first to last."""
        return map(self.frame, spread(len(self), most))


def first_axis_of_pages(array: ForeignArray, shape: tuple[int, int]) -> Literal[0, 2] | None:
    """Return 0 where pages of a shape lie along the first axes of an array, 2 where along the last, else None."""
    fits: dict[Literal[0, 2], bool] = {0: array.shape[-2:] == shape, 2: array.shape[:2] == shape}
    order: tuple[Literal[0, 2], ...] = (0,) if array.of_pictures or len(array.shape) == 2 else (0, 2)
    return next((axis for axis in (order[::-1] if array.pages_last else order) if fits[axis]), None)


def whole_counts(data: NDArray[Any], subject: str) -> Counts:
    """Return values as whole counts of 8 or 16 bits.

    Raises:
        FrameError: values that are none.
    """
    if data.dtype.kind not in "uif":
        raise FrameError(subject, f"type {data.dtype}", "whole counts")
    if data.dtype.kind == "f":
        if not np.isfinite(data).all():
            raise FrameError(subject, f"{np.count_nonzero(~np.isfinite(data))} values that are no numbers", "counts")
        if np.any(odd := data != np.rint(data)):
            value = data[odd].flat[0]
            remedy = "multiply by full scale, and round" if data.max() <= 1 else "round them"
            raise FrameError(subject, f"a value of {value:.6g}", f"whole counts: {remedy}")
    low, high = data.min(), data.max()
    if low < 0 or high > _MOST_COUNT:
        raise FrameError(subject, f"values from {low} to {high}", f"counts from 0 to {_MOST_COUNT}")
    return data.astype(np.uint8 if data.dtype == np.uint8 else np.uint16, copy=False)


def one_camera(array: ForeignArray, shape: tuple[int, int], upright: Upright, what: str) -> Frames:
    """Return the frames of an array that one camera has made; arguments as there.

    Raises:
        InvalidInputError: pictures of another size.
    """
    pages = Pages(array, upright.before(shape), what)
    return Frames(pages, range(pages.count), (slice(None), slice(None)), upright)


def both_cameras(
    array: ForeignArray,
    shape: tuple[int, int],
    uprights: tuple[Upright, Upright],
    arrangement: Arrangement | None,
    what: str,
) -> tuple[Frames, Frames]:
    """Return the in-phase and the quadrature frames of one array.

    Args:
        array: that holds both.
        shape: rows and columns of an upright frame.
        uprights: how frames of either camera are set upright.
        arrangement: how they lie; where there is just one way, it is found if left out.
        what: a frame is, for errors.

    Raises:
        InvalidInputError: pictures of another size, an odd number of them, or an arrangement that has to be told.
    """
    stored = {upright.before(shape) for upright in uprights}
    if len(stored) > 1:
        raise InvalidInputError(array.subject, "cameras that are turned differently", "a file for each")
    rows, columns = stored.pop()
    arrangement = arrangement or _found(array, (rows, columns))
    everything = slice(None)
    if arrangement in (Arrangement.SIDE_BY_SIDE, Arrangement.ABOVE):
        beside = arrangement is Arrangement.SIDE_BY_SIDE
        pages = Pages(array, (rows, 2 * columns) if beside else (2 * rows, columns), f"two {what} {arrangement}")
        size = columns if beside else rows
        halves = slice(0, size), slice(size, None)
        cuts = [(everything, half) if beside else (half, everything) for half in halves]
        numbers = [range(pages.count)] * 2
    else:
        pages = Pages(array, (rows, columns), what)
        _check_cameras(pages, arrangement)
        if pages.count % 2:
            raise InvalidInputError(array.subject, f"{pages.count} frames", "as many of one camera as of the other")
        cuts, half = [(everything, everything)] * 2, pages.count // 2
        numbers = (
            [range(0, pages.count, 2), range(1, pages.count, 2)]
            if arrangement is Arrangement.INTERLEAVED
            else [range(half), range(half, pages.count)]
        )
    first, second = (Frames(pages, *each) for each in zip(numbers, cuts, uprights, strict=True))
    return first, second


def _check_cameras(pages: Pages, arrangement: Arrangement) -> None:
    """Check that one of two axes of pages is that of the cameras, and the one that the arrangement says."""
    axes = [size for size in pages.outer if size > 1]
    place = -1 if arrangement is Arrangement.INTERLEAVED else 0
    if len(axes) > 1 and axes[place] != 2:
        got = f"axes of {' x '.join(map(str, axes))} frames"
        expected = f"two cameras along the {'inner' if place else 'outer'} one, as {arrangement} says"
        raise InvalidInputError(pages.subject, got, expected)


def _found(array: ForeignArray, shape: tuple[int, int]) -> Arrangement:
    """Return the one way in which both cameras' frames can lie in an array."""
    rows, columns = shape
    ends = array.shape[-2:], array.shape[:2]
    axis = first_axis_of_pages(array, shape)
    if axis is None and (rows, 2 * columns) in ends:
        return Arrangement.SIDE_BY_SIDE
    if axis is None and (2 * rows, columns) in ends:
        return Arrangement.ABOVE
    outer = array.shape[2:] if axis else array.shape[:-2]
    if outer in ((2,), (2, 1), (1, 2)):
        return Arrangement.HALVES
    if len(outer) == 2 and outer.count(2) == 1:
        return Arrangement.HALVES if outer[0] == 2 else Arrangement.INTERLEAVED
    ways = ", ".join(Arrangement)
    raise InvalidInputError(array.subject, f"shape {array.shape}, which does not tell", f"--arrangement: {ways}")
