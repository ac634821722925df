"""A graph for batches of the toy device, that is held until it may run."""

from functools import partial
from threading import Event, Thread
from typing import cast

import numpy as np

from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.decoding.batch_graph import BatchGraph, Constants, FrameBuffer
from lightpage.runtime.model.decoding.batches import Batches, Batching
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.page import Inference
from lightpage.runtime.model.decoding.under_way import Phase
from lightpage.runtime.model.execution.session import BoundSession
from tests.runtime import toy
from tests.waiting import LIMIT_S, eventually

LARGEST = 4


class HeldGraph:
    """Decodes each page of a batch as the toy does, once it may."""

    subject, pages = "bundle toy: batch.onnx", LARGEST

    def __init__(self, decoder: Decoder) -> None:
        self._decoder, self.may_run = decoder, Event()
        nowhere = np.zeros((2, 2, 10), np.float32)
        self.constants_of_bundle = Constants(nowhere, cast(BoundSession, None), reach_px=1.0)

    def buffer(self) -> FrameBuffer:
        return FrameBuffer(self.pages, toy.SHAPE, "uint8")

    def run(self, constants: Constants, buffer: FrameBuffer, pages: slice) -> list[Inference]:
        assert self.may_run.wait(LIMIT_S)
        shown = zip(*(buffer.frames[name][pages] for name in ("in_phase", "quadrature")), strict=True)
        return [self._decoder.infer(FramePair(*frames), doubtful=True, alone=True) for frames in shown]

    def run_together(self, batching: Batching) -> None:
        """Have it run once several pages wait for it."""
        several = partial(eventually, lambda: batching.pages.count(Phase.WAITING) > 1)
        Thread(target=lambda: several() and self.may_run.set()).start()

    def gathering(self, batching: Batching) -> Decoder:
        """The toy's decoder, whose pages are gathered for it."""
        own = self._decoder
        batches = Batches(cast(BatchGraph, self), own.graph, batching)
        return Decoder(own.bundle, own.threads, own.graph, batches=batches)
