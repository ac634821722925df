"""A bundle's graph for batches, opened; the constants of a table that it runs with, and the memory of its frames."""

import logging
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import BundleError, ProviderError, SurroundingsError
from lightpage.failures import lacks_memory
from lightpage.progress import warn
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.bundle.manifest import BATCH, CONSTANTS, FLOAT16
from lightpage.runtime.model.decoding.golden import check_golden
from lightpage.runtime.model.decoding.page import OUTPUTS, Inference
from lightpage.runtime.model.execution.device_memory import ON_NO_DEVICE, Copies
from lightpage.runtime.model.execution.page_graph import REGISTRATION, PageGraph
from lightpage.runtime.model.execution.session import BoundSession, OnDevice, open_session, running

_log = logging.getLogger(__name__)

_FILES = {CONSTANTS, BATCH}
SHIFT = "shift"
"""Input of the images' shifts against the registration of the constants, (x, y) of either camera, pixels [B, 2, 2]."""
REACH = 0.003
"""Largest shift by which constants serve, as a share of the frame's width: the beam is taken to be where they have it,
and changes the light by so little."""


@dataclass(frozen=True)
class Constants:
    """Tensors that follow from a table alone, where the graph computes.

    Attributes:
        registration: registration in the table, [2, 2, 10].
        bound: the graph, run with them.
        reach_px: see `REACH`.
    """

    registration: NDArray[np.float32]
    bound: BoundSession
    reach_px: float

    def shift_of(self, registration: NDArray[np.float32]) -> NDArray[np.float32] | None:
        """The shift of an image against it, [2, 2] pixels; None where there is none like it, or it is beyond reach."""
        apart = registration - self.registration
        shift = apart[..., 0].astype(np.float32)
        reached = not apart[..., 1:].any() and np.abs(shift).max() <= self.reach_px
        return shift if reached else None


class FrameBuffer:
    """Memory for the frames of a batch: pages are written in from many threads, each to its own place.

    For a GPU it is pinned, and a page is copied there once it is written, while a run from another buffer is on.

    Args:
        pages: largest number of pages.
        frame_shape, dtype: shape and type of a frame.
        copies: maker of the copy on a device.
    """

    def __init__(self, pages: int, frame_shape: tuple[int, int], dtype: str, copies: Copies = ON_NO_DEVICE) -> None:
        both = np.zeros((2, pages, *frame_shape), dtype)
        self.pages, self.frames = pages, dict(zip(("in_phase", "quadrature"), both, strict=True))
        self.shift = np.zeros((pages, 2, 2), np.float32)
        self._copy = copies.of(both)

    def put(self, place: int, pair: FramePair, shift: NDArray[np.float32]) -> None:
        """Write a page.

        Raises:
            ProviderError: the device failed.
        """
        self.frames["in_phase"][place], self.frames["quadrature"][place] = pair.in_phase, pair.quadrature
        self.shift[place] = shift
        if self._copy is not None:
            self._copy.send(*(frames[place] for frames in self.frames.values()))

    def feeds(self, pages: slice) -> dict[str, NDArray[np.generic] | OnDevice]:
        """Inputs of some pages, by name; what was written before stands where nothing was since."""
        frames, copy = {name: array[pages] for name, array in self.frames.items()}, self._copy
        there = frames if copy is None else {name: copy.of(part) for name, part in frames.items()}
        return {**there, SHIFT: self.shift[pages]}


class BatchGraph:
    """The graph for batches of a bundle. It never changes; its methods may be called from many threads at once.

    The golden page is decoded alone, and among the most pages, in the first and in the last place.

    Args:
        bundle: bundle that has such a graph.
        graph: graph of its decoder, with its provider and its table.
        pages: largest number of pages of a run.
        threads: number of threads of a run on the CPU.

    Attributes:
        subject: what it is, for errors.
        pages: largest number of pages of a run; fewer than were wanted where there is no memory for so many.
        constants_of_bundle: those of the graph's table.

    Raises:
        BundleError: the bundle has no such graph, or the golden page comes out differently.
        ProviderError: there is no such provider here.
    """

    def __init__(self, bundle: Bundle, graph: PageGraph, pages: int, threads: int | None = None) -> None:
        self.subject = f"{bundle.subject}: {BATCH}"
        if missing := _FILES - bundle.files.keys():
            raise BundleError(f"{bundle.subject}: files", f"no {', '.join(sorted(missing))}", "a graph for batches")
        self._bundle, self._provider, self._copies = bundle, graph.provider, Copies(graph.provider)
        self._session = open_session(bundle.files[BATCH], self.subject, threads, provider=graph.provider, rounded=True)
        if SHIFT not in {node.name for node in self._session.get_inputs()}:
            raise BundleError(self.subject, f"no input {SHIFT}", "an export by this version of Lightpage")
        # stays open, since opening it takes longer than running it; `once` has it keep no memory
        self._first = open_session(bundle.files[CONSTANTS], f"{bundle.subject}: {CONSTANTS}", threads, once=True)
        self.constants_of_bundle = self.constants(graph)
        self.fit(pages)

    def fit(self, pages: int) -> None:
        """Have so many pages a run, or as many as there is memory for; raises as the constructor does."""
        self.pages = pages
        while not self._has_room():
            self.pages = fewer(self.pages)
            _log.warning("%s: batches of %d pages, since memory is short", self.subject, self.pages)

    def _has_room(self) -> bool:
        """Check the golden page alone and among the most pages, and return whether there is memory for so many."""
        buffer = self.buffer()
        try:
            for place, count in {0: 1, self.pages - 1: self.pages}.items():
                check_golden(self._bundle, partial(self._golden, buffer, place, count), FLOAT16)
        except (ProviderError, SurroundingsError) as error:
            if self.pages == 1 or not lacks_memory(error):
                raise
            return False
        return True

    def buffer(self) -> FrameBuffer:
        """Memory for the frames of a run."""
        manifest = self._bundle.manifest
        return FrameBuffer(self.pages, self._bundle.profile.frame_shape, manifest.frame_dtype, self._copies)

    def constants(self, graph: PageGraph, registration: NDArray[np.float32] | None = None) -> Constants:
        """Constants of a table, computed on the CPU.

        Args:
            graph: graph with that table.
            registration: registration in place of the table's.
        """
        names = [node.name for node in self._first.get_outputs()]
        table = {node.name: graph.value(node.name) for node in self._first.get_inputs()}
        if registration is not None:
            table[REGISTRATION] = registration
        with running(self.subject):
            made = dict(zip(names, self._first.run(names, table), strict=True))
        bound = BoundSession(self._session, self._provider, made, self.subject)
        return Constants(table[REGISTRATION], bound, REACH * self._bundle.profile.frame_shape[1])

    def run(self, constants: Constants, buffer: FrameBuffer, pages: slice) -> list[Inference]:
        """The answers of the graph to some pages in a buffer; of their residuals no one has judged.

        Raises:
            BundleError: other answers than one a page.
            ProviderError: a GPU failed, or has no room.
            SurroundingsError: memory or threads are short.
        """
        count = pages.stop - pages.start
        # of few sizes, since a GPU looks for kernels at each: others are computed beside them, whatever they are
        size = min(buffer.pages - pages.start, 1 << (count - 1).bit_length())
        feeds = buffer.feeds(slice(pages.start, pages.start + size))
        answers = list(zip(*constants.bound.run([*OUTPUTS, "residual"], feeds), strict=True))
        if len(answers) != size:
            raise BundleError(f"{self.subject}, pages of an answer", len(answers), f"{size}, as many as were asked for")
        return [Inference(p, phase, length, float(left)) for p, phase, length, left in answers[:count]]

    def _golden(self, buffer: FrameBuffer, place: int, pages: int, pair: FramePair) -> NDArray[np.float32]:
        """The answer to a page at a place among others that are no pages, p."""
        for number in range(pages):
            frames = pair if number == place else FramePair(pair.quadrature, pair.in_phase)
            buffer.put(number, frames, np.zeros((2, 2), np.float32))
        return self.run(self.constants_of_bundle, buffer, slice(0, pages))[place].p


def fewer(pages: int) -> int:
    """The next smaller size of a run."""
    return 1 << ((pages - 1).bit_length() - 1)


def with_proven_batches(bundle: Bundle, graph: PageGraph) -> Bundle:
    """The bundle, without its graph for batches and a warning where that does not decode the golden page as it should.

    Args:
        bundle: bundle in memory.
        graph: graph of its decoder, with its table.
    """
    if not holds_batches(bundle):
        return bundle
    try:
        BatchGraph(bundle, graph, pages=2)
    except BundleError as differing:
        warn(f"no decoder for many pages: {differing}")
        return replace(bundle, files={name: data for name, data in bundle.files.items() if name not in _FILES})
    return bundle


def holds_batches(bundle: Bundle) -> bool:
    """Return whether a bundle has a graph for batches."""
    return bundle.files.keys() >= _FILES
