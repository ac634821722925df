"""Heals a model that no longer reads its device by pages of user data that nobody knows.

A round decodes some pages, takes off the smooth error that their pilots share, decides every symbol, and fits the
geometry by the decisions of one page. As soon as the checksum of a page holds, all of its symbols are known, and the
model is re-fitted by it as by any known page.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.calibrate import KnownPage, goodness_of, refine
from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.document import Calibration
from lightpage.calibration.interfaces import Twin
from lightpage.calibration.parameters import as_dict
from lightpage.calibration.sampling_table import moved_cameras
from lightpage.codec.code import Code
from lightpage.codec.page_bytes import Header, Loss, PageBytes
from lightpage.errors import (
    CalibrationError,
    FrameError,
    InvalidInputError,
    PageError,
    RecalibrationRefusedError,
    raised_as,
)
from lightpage.page.pilots import LEAST_CONFIRMED_NATS
from lightpage.page.symbols import symbol_phases
from lightpage.progress import Progress
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import hash_frames
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_drift import BundleSearch
from lightpage.runtime.model.decoding.image_position import ImagePosition
from lightpage.runtime.model.execution.twin import OnnxTwin
from lightpage.runtime.recalibration.known_pages import KnownPages
from lightpage.runtime.recalibration.recalibration import Refit, RefitResult, refitted_bundle
from lightpage.runtime.recalibration.refit import blemishes_of, refit, traced
from lightpage.runtime.recalibration.unknown_pages import UnknownPages

TOGETHER = 6
"""Pages at most that one healing takes: the pilots of six show a smooth error as well as it can be shown."""

MOST_ROUNDS = 8
"""Largest number of rounds. The bench device takes one to three where one thing has changed, and six where angle,
focus, stroke and both cameras have."""

_IN_VAIN = 2
"""Rounds that bring the pages no nearer to being read, after which healing ends: their bits are those of no page."""

_LEAST_PROGRESS = 0.02
"""Least relative fall of what all pages lack by which a round brings them nearer."""

_AROUND_PX = np.array([(x, y) for x in (-20.0, 0.0, 20.0) for y in (-20.0, 0.0, 20.0)])
"""Where the image is looked for, beside where it was last seen: it is found within some thirty pixels."""


_WANTED = "pages of this device that its drift, and nothing else, keeps from being read"
"""What a healing is for."""


@dataclass(frozen=True)
class LostPages:
    """Pages of one device that its model does not read.

    Attributes:
        pairs: frame pairs, one a page.
        code: code of the pages.
        expected: the page of its volume that each should be, None where that is unknown; none for none of them.
        references: reference-only frames taken with them, or None: then those that the model decodes with hold.
        image_px: where the image was last seen against the model's calibration, (x, y), camera pixels.
    """

    pairs: tuple[FramePair, ...]
    code: Code
    expected: tuple[Header | None, ...] = ()
    references: FramePair | None = None
    image_px: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Healed:
    """A model that reads its device again.

    Attributes:
        decoder: decoder of the re-fitted bundle, which lies in memory.
        result: what was re-fitted, with the verdict on it. It may be wrong: pages that come right are right even so.
        known: pages that come right, with their symbols; those that were fitted are the first.
        rounds: number of rounds of fits to decisions; 0 where only the image had moved.
        seconds: time that it took.
    """

    decoder: Decoder
    result: RefitResult
    known: KnownPages
    rounds: int
    seconds: float


def heal(
    decoder: Decoder,
    pages: LostPages,
    progress: Progress = lambda what, share: None,
    fit: Refit = refit,
    twin: Twin | None = None,
) -> Healed:
    """Find the device's geometry again, and with it the pages.

    Args:
        decoder: the model that does not read them; it is not touched.
        pages: at most `TOGETHER` are taken, the first ones; repeated ones count once.
        progress: told of every step. It may raise to stop the work.
        fit: how to fit by known pages.
        twin: twin of the bundle's profile; the bundle's own if left out.

    Raises:
        RecalibrationRefusedError: the frames do not show this device, no page came right, or the bundle has no
            calibration to start from.
        BundleError: the bundle holds a geometry that cannot be fitted, or no graph that shows the field.
    """
    start = time.perf_counter()
    with raised_as(RecalibrationRefusedError, CalibrationError, FrameError, InvalidInputError, PageError):
        work = _Healing(decoder, pages, OnnxTwin(decoder.bundle) if twin is None else twin)
        model = work.model
        rounds = 0
        in_vain = 0
        least = np.inf
        while (known := work.known(model)) is None:
            lacking = work.lacking_of_all(model)
            in_vain += lacking == 0 or lacking >= (1 - _LEAST_PROGRESS) * least
            least = min(least, lacking)
            if rounds == MOST_ROUNDS or in_vain == _IN_VAIN:
                got = f"{len(work.pairs)} pages of which none is read after round {rounds}; {work.unread(model)}"
                raise RecalibrationRefusedError("healing", got, _WANTED)
            rounds += 1
            model = work.fitted(model, partial(_within, progress, rounds))
        told = partial(_within, progress, MOST_ROUNDS + 1)
        try:
            result = fit(decoder.bundle, known.part(slice(1)), told, decoder)
        except CalibrationError:
            model = work.judged(model, known, told)
        else:
            by_known = model.by(known.pairs[0], decoder.of_bundle(refitted_bundle(decoder.bundle, result)), result)
            # one more page is worth more than a little more of each
            model = by_known if work.count(by_known) >= work.count(model) else work.judged(model, known, told)
        result = replace(model.result, report=replace(model.result.report, image=work.image))
        return Healed(model.decoder, result, work.known(model) or known, rounds, time.perf_counter() - start)


class _Model(NamedTuple):
    """A decoder whose bundle lies in memory, what was re-fitted for it, and the pages of all fits on its way.

    The page of the last fit comes first; there is none for the first model.
    """

    decoder: Decoder
    result: RefitResult
    fitted: tuple[FramePair, ...] = ()

    @property
    def last(self) -> FramePair | None:
        """The page of the last fit."""
        return self.fitted[0] if self.fitted else None

    def by(self, pair: FramePair, decoder: Decoder, result: RefitResult) -> _Model:
        """The model of another fit, by `pair`, that began with this one."""
        return _Model(decoder, result, (pair, *(other for other in self.fitted if other is not pair)))


def _within(progress: Progress, rounds: int, what: str, share: float) -> None:
    """Tell of a step of a round, the fit to known pages being the last one."""
    progress(what if rounds > MOST_ROUNDS else f"round {rounds}: {what}", (rounds - 1 + share) / (MOST_ROUNDS + 1))


class _Healing:
    """The pages of a healing, and what is done with them.

    Args:
        decoder, pages, twin: as for `heal`.

    Attributes:
        pairs: the pages that are taken.
        model: the model with the image where it lies now.
        image: where that is.
    """

    def __init__(self, decoder: Decoder, pages: LostPages, twin: Twin) -> None:
        self._decoder, self._pages, self._twin = decoder, pages, twin
        bundle = decoder.bundle
        lit = [(number, pair) for number, pair in enumerate(pages.pairs) if _shows_light(decoder, pair)]
        distinct = {hash_frames(pair): number for number, pair in reversed(lit)}
        taken = sorted(distinct.values())[:TOGETHER]
        if not taken:
            raise RecalibrationRefusedError("healing", "no page with light", "at least one")
        if pages.references is not None:
            decoder.check(pages.references, "reference: ")
        self._blemishes = blemishes_of(decoder, pages.references)
        self._references = self._blemishes.references
        self._levels = pages.code.levels
        self.pairs = tuple(pages.pairs[number] for number in taken)
        expected = tuple(pages.expected[number] if pages.expected else None for number in taken)
        self._shown = UnknownPages(self.pairs, expected, pages.code, bundle.written_pilots(self._levels), twin)
        self.image = self._found()
        moved = moved_cameras(bundle.calibration.vector, np.array([self.image.shift_x_px, self.image.shift_y_px]))
        self._start = bundle.calibration.model_copy(update={"parameters": as_dict(moved)})
        self.model = _Model(*self._with(self._start))

    def _found(self) -> ImagePosition:
        """Return the image position: by one page's pilots, or else where it was, if those of all pages agree there.

        Raises:
            RecalibrationRefusedError: no page shows it.
        """
        decoder = self._decoder
        search, pilots = BundleSearch(decoder, self._twin), self._shown.pilots_of(decoder)
        around = np.concatenate([_AROUND_PX, [self._pages.image_px]])
        for pair in self.pairs:
            found = search.find(pair, pilots, around, self._references)
            if found.found:
                x, y = map(float, found.shift_px)
                return ImagePosition(x, y, searched=True, found=True)
        checks = [page.check for page in self._shown.look(decoder).pages]
        told = sum(check.confirmed_bits * np.log(2) * check.pilots - check.gained_nats for check in checks)
        if told >= LEAST_CONFIRMED_NATS:
            return ImagePosition(0.0, 0.0, searched=True, found=False)
        got = f"{len(self.pairs)} pages without this device's pilots ({told:.1f} of {LEAST_CONFIRMED_NATS} nats)"
        raise RecalibrationRefusedError("healing", got, _WANTED)

    def _with(self, calibration: Calibration) -> tuple[Decoder, RefitResult]:
        """The decoder with another geometry, and what was re-fitted for it."""
        gains = self._blemishes.gains
        result = traced(self._decoder, self._twin, self._references, calibration, gains=gains)
        return self._decoder.of_bundle(refitted_bundle(self._decoder.bundle, result)), result

    def _read(self, model: _Model) -> tuple[PageBytes, ...]:
        """Return what the pages give a model."""
        return self._shown.look(model.decoder, model.last).read

    def count(self, model: _Model) -> int:
        """Return how many pages a model reads."""
        return sum(page.loss is None for page in self._read(model))

    def lacking(self, model: _Model) -> float:
        """Return what the page that is nearest to being read lacks by its own claims, bits a symbol to two digits."""
        return round(max(0.0, min(-page.margin_bits for page in self._read(model))), 2)

    def lacking_of_all(self, model: _Model) -> float:
        """Return what all pages together lack by their own claims, bits a symbol."""
        return sum(max(0.0, -page.margin_bits) for page in self._read(model))

    def unread(self, model: _Model) -> str:
        """Return how far the page that is nearest is from being read."""
        if decoded := sum(page.loss is Loss.CHECKSUM for page in self._read(model)):
            return f"{decoded} fail in bits that their LDPC blocks, which all converge, leave out"
        lacking = self.lacking(model)
        told = f"the nearest lacks {lacking} bit a symbol by its own claims"
        return told if lacking else "one claims enough, and no checksum holds"

    def known(self, model: _Model) -> KnownPages | None:
        """The pages that come right, the fitted ones first, then by what they have to spare; None if none does."""
        read = [(page, pair) for page, pair in zip(self._read(model), self.pairs, strict=True) if page.loss is None]
        if not read:
            return None
        order = {id(pair): place for place, pair in enumerate(model.fitted)}
        read.sort(key=lambda one: (order.get(id(one[1]), len(order)), -one[0].margin_bits))
        codec = self._shown.codec(model.decoder)
        symbols = tuple(codec.encode_again(page, self._shown.pilots) for page, _ in read)
        image_px = self.image.shift_x_px, self.image.shift_y_px
        pairs = tuple(pair for _, pair in read)
        mask, near = model.decoder.bundle.pilot_mask, self._near(model) if model.fitted else None
        fitted = tuple(map(hash_frames, model.fitted))
        return KnownPages(pairs, symbols, self._levels, self._pages.references, mask, image_px, near, fitted)

    def _near(self, model: _Model) -> CalibratedDevice:
        """Return the device as a model has it."""
        bundle = model.decoder.bundle
        return bundle.calibration.device(bundle.profile, self._references)

    def fitted(self, model: _Model, progress: Progress) -> _Model:
        """The model of a fit to what `model` decides, its smooth error off."""
        progress("decide", 0.0)
        page, symbols = self._shown.decided(model.decoder, model.last)
        profile, earlier = model.decoder.bundle.profile, self._start
        registered = refine(
            self._twin,
            self._decoder.field_solver,
            profile,
            self._references,
            [self._known_page(self.pairs[page], symbols)],
            start=earlier.vector,
            quadrature_phase=earlier.turn_rad,
            progress=progress,
            modulation=earlier.modulator,
            near=self._near(model),
            rough=True,
        )
        hashes = {hash_frames(pair): None for pair in (self.pairs[page], *model.fitted)}
        found = earlier.followed_by(Calibration.from_registered(registered, profile, [*hashes]))
        return model.by(self.pairs[page], *self._with(found))

    def _known_page(self, pair: FramePair, symbols: NDArray[np.uint8]) -> KnownPage:
        """Return a page without the cameras' blemishes."""
        return KnownPage(self._blemishes.corrected(pair), np.exp(1j * symbol_phases(symbols, self._levels)))

    def judged(self, model: _Model, known: KnownPages, progress: Progress) -> _Model:
        """The model with the verdict on its geometry, by the light of the first known page.

        A fit to decisions gives none: those that are wrong would count as light that the geometry does not explain.
        That of a geometry that has only been moved is of before.
        """
        bundle = model.decoder.bundle
        page = self._known_page(known.pairs[0], known.symbols[0])
        estimated = goodness_of(self._twin, self._near(model), page, lambda _: progress("unexplained light", 1.0))
        goodness = bundle.calibration.of_refit(estimated)
        return _Model(
            *self._with(bundle.calibration.model_copy(update={"goodness": goodness, "reading": None})), model.fitted
        )


def _shows_light(decoder: Decoder, pair: FramePair) -> bool:
    """Return whether a decoder takes the frames, and finds the light of a page on them."""
    try:
        decoder.check(pair)
        decoder.infer(pair, doubtful=True)
    except FrameError:
        return False
    return True
