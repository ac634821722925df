"""Many pages in one run of a bundle's graph for batches."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import BundleError, InvalidInputError
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.bundle.manifest import BATCH, CONSTANTS, FLOAT16
from lightpage.runtime.model.decoding.decoder import OUTPUTS, Decoder, check_golden, check_residual
from lightpage.runtime.model.decoding.page import Inference
from lightpage.runtime.model.execution.session import BoundSession, Session, open_session, running


class BatchDecoder:
    """A decoder's graph for many pages, with the decoder's table, threads and provider. It never changes.

    Args:
        decoder: of a bundle that has such a graph.
        pages: of a run; fewer take as long.
        like: of the same bundle and as many pages, with another table: what runs is shared with it, and its golden page
            is not looked at again.

    Raises:
        BundleError: the bundle has no such graph, or the golden page comes out differently.
        ProviderError: there is no such provider here.
    """

    def __init__(self, decoder: Decoder, pages: int, like: BatchDecoder | None = None) -> None:
        bundle, graph = decoder.bundle, decoder.graph
        if missing := {CONSTANTS, BATCH} - bundle.files.keys():
            raise BundleError(f"{bundle.subject}: files", f"no {', '.join(sorted(missing))}", "a graph for batches")
        self.decoder, self.pages, subject = decoder, pages, f"{bundle.subject}: {BATCH}"
        if like is not None and (like.pages, like.decoder.bundle.files[BATCH]) != (pages, bundle.files[BATCH]):
            raise BundleError(f"{bundle.subject}: {BATCH}", "another graph, or as many pages", "those of the first one")
        first = open_session(bundle.files[CONSTANTS], f"{bundle.subject}: {CONSTANTS}", decoder.threads, once=True)
        names = [node.name for node in first.get_outputs()]
        with running(subject):
            made = first.run(names, {node.name: graph.value(node.name) for node in first.get_inputs()})
        self._session: Session = (
            like._session
            if like is not None
            else open_session(bundle.files[BATCH], subject, decoder.threads, provider=graph.provider, pages=pages)
        )
        self._bound = BoundSession(self._session, graph.provider, dict(zip(names, made, strict=True)), subject)
        if like is None:
            for place in {0, pages - 1}:
                check_golden(bundle, partial(self._among_others, place), FLOAT16)

    def _among_others(self, place: int, pair: FramePair) -> NDArray[np.float32]:
        """What is said of a page at a place of a run whose other pages are no pages."""
        run = [FramePair(pair.quadrature, pair.in_phase)] * self.pages
        run[place] = pair
        return self.infer(run, doubtful=True)[place].p

    def infer(self, pairs: Sequence[FramePair], *, doubtful: bool = False) -> list[Inference]:
        """Run the graph on checked pairs, as `Decoder.infer` does on one; it raises for the first that is refused.

        Raises:
            InvalidInputError: no pair, or more than a run's.
        """
        if not 0 < len(pairs) <= self.pages:
            raise InvalidInputError("pages of a batch", len(pairs), f"1 to {self.pages}")
        filled = [*pairs, *[pairs[-1]] * (self.pages - len(pairs))]
        feeds = {name: np.stack([getattr(pair, name) for pair in filled]) for name in ("in_phase", "quadrature")}
        answers = list(zip(*self._bound.run([*OUTPUTS, "residual"], feeds), strict=True))
        if len(answers) != self.pages:
            subject = f"{self.decoder.bundle.subject}: {BATCH}, pages of an answer"
            raise BundleError(subject, len(answers), f"{self.pages}, as many as were asked for")
        read = [Inference(p, phase, length, float(residual)) for p, phase, length, residual in answers[: len(pairs)]]
        for page in read:
            check_residual(page.residual, self.decoder.bundle.manifest.residual_limit, doubtful=doubtful)
        return [self.decoder.view.seen(page) for page in read]
