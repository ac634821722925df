"""Decodes frame pairs with a bundle: checks, one ONNX run, piston from the pilots, decision with confidence."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.likelihood.table import pilot_tensors
from lightpage.calibration.sampling_table import SamplingTable
from lightpage.errors import BundleError, FrameError, InvalidInputError, NoCodeError, raised_as
from lightpage.metrics.information import decide_with_confidence
from lightpage.page.correction import PhaseRefit, corrected
from lightpage.page.levels import MAX_LEVELS, check_levels
from lightpage.page.pilots import Pilots
from lightpage.recording.exposure import check_light
from lightpage.recording.frame_pair import FramePair, check_pair
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.decoding.batches import NO_BATCHES, Batches, Batching, OneByOne
from lightpage.runtime.model.decoding.camera_view import CameraView
from lightpage.runtime.model.decoding.field_solver import BundleFieldSolver
from lightpage.runtime.model.decoding.golden import check_golden
from lightpage.runtime.model.decoding.page import OUTPUTS, DecodedPage, Inference, StepLimit, Timings, check_residual
from lightpage.runtime.model.execution.estimator_graph import RESIDUAL, EstimatorGraph
from lightpage.runtime.model.execution.page_graph import (
    PAGE_INPUTS,
    REGISTRATION,
    PageGraph,
    check_ports,
    check_steps,
    open_graph,
)
from lightpage.runtime.model.execution.providers import ON_CPU, Provider
from lightpage.words import brief

if TYPE_CHECKING:
    from lightpage.codec.code import Code
    from lightpage.codec.page_codec import PageCodec


def _told(decoder: Decoder) -> str:
    """Return what a decoder says of itself."""
    profile = f"profile {decoder.bundle.profile.name}"
    return brief(decoder, decoder.version, profile, f"on {decoder.graph.provider}")


class Decoder:
    """The decoder of one bundle. Its methods may be called from many threads at once.

    It does not follow the image as it moves: a `FollowingDecoder`, which `lightpage.load` gives, does.

    Args:
        bundle: an opened bundle.
        threads: threads of one inference; by default the cores that this process may use.
        graph: graph of the bundle, where it is open already; then neither it nor the golden page is looked at.
        provider: what pages are computed with; all else is computed on the CPU.
        code_threads: threads that share the code of a page, where it is compiled.
        batching: how its pages are gathered with those of other callers.
        batches: batches that gather them, where they are open already.
        steps: largest number of Gauss-Newton steps of a page; None for as many as the bundle has. A network has none.

    Raises:
        ProviderError: there is no such provider here.
        BundleError: graph, table or pilots do not fit the profile, or the golden page comes out differently.
    """

    def __init__(
        self,
        bundle: Bundle,
        threads: int | None = None,
        graph: PageGraph | None = None,
        provider: Provider = ON_CPU,
        code_threads: int = 1,
        batching: Batching = NO_BATCHES,
        batches: OneByOne | None = None,
        steps: int | None = None,
    ) -> None:
        self.bundle, self.threads, self.code_threads = bundle, threads, code_threads
        self.steps = steps
        self.graph = graph or open_graph(bundle, threads, provider, steps)
        self.batches, self._batching = batches or OneByOne(), batching
        residual = bundle.manifest.residual_output
        self._outputs = [*OUTPUTS, *([residual] if residual else [])]
        self._estimates = isinstance(self.graph, EstimatorGraph)
        self._pilots: dict[int, Pilots] = {}
        if graph is None:
            check_ports(self.bundle, self.graph)
            self.pilots(MAX_LEVELS)  # damaged pilots are noticed now, not with the first page
            if bundle.code is not None:
                _ = self.page_codec
            self._check_golden()
            self.batches = Batches.opened(bundle, self.graph, batching, threads)

    __repr__ = _told

    @classmethod
    def load(
        cls,
        path: str | Path,
        threads: int | None = None,
        provider: Provider = ON_CPU,
        batching: Batching = NO_BATCHES,
        code_threads: int = 1,
        steps: int | None = None,
    ) -> Decoder:
        """Open the bundle at `path` and its decoder.

        Raises:
            InvalidInputError: the bundle has fewer than so many `steps`, or none.
            BundleError, ProviderError: see `Bundle.open` and the constructor.
        """
        bundle = Bundle.open(path)
        check_steps(bundle, steps)
        return cls(bundle, threads, provider=provider, batching=batching, code_threads=code_threads, steps=steps)

    def of_another(self, bundle: Bundle) -> Decoder:
        """The decoder of another bundle, with this one's threads, provider and limit of steps; see the constructor."""
        provider, batching, codes = self.graph.provider, self._batching, self.code_threads
        return Decoder(bundle, self.threads, provider=provider, code_threads=codes, batching=batching, steps=self.steps)

    def with_table(self, table: SamplingTable) -> Decoder:
        """This decoder with other tensors in its table, by name; those left out stay. The golden page is not looked at.

        Raises:
            InvalidInputError: a table that does not fit.
        """
        return _like(self, self.bundle, self.graph.with_table(table))

    def taken(self, table: SamplingTable) -> SamplingTable:
        """The tensors of a traced table that the graph takes; of parameters those that it knows, the first ones."""
        ports = self.graph.ports
        taken = {name: value for name, value in table.items() if name in ports}
        if "parameters" in taken:
            taken["parameters"] = taken["parameters"][: ports["parameters"].shape[0]]
        return taken

    def of_bundle(self, bundle: Bundle) -> Decoder:
        """This decoder with the table of a bundle of the same graphs, whose golden page is not looked at.

        Raises:
            BundleError: its table does not fit.
        """
        with raised_as(BundleError, InvalidInputError, about=f"{bundle.subject}: "):
            return _like(self, bundle, self.graph.with_table(bundle.table))

    @property
    def references(self) -> FramePair:
        """The reference-only frames that this decoder decodes with.

        Raises:
            InvalidInputError: its table holds none.
        """
        in_phase, quadrature = (self.graph.value(f"reference_{name}") for name in ("in_phase", "quadrature"))
        return FramePair(in_phase, quadrature)

    @property
    def version(self) -> str:
        """The bundle's version."""
        return self.bundle.version

    def pilots(self, levels: int, mask: NDArray[np.bool_] | None = None) -> Pilots:
        """The pilots that this device's pages carry at `levels` levels.

        The device's own phases where the bundle holds them, whatever `levels` is, else the profile's seeded pattern.

        Args:
            levels: M.
            mask: where a page's pilots are, bool [ny, nx], if not where the bundle has them: then the pattern holds.
        """
        if mask is not None and not np.array_equal(mask, self.bundle.pilot_mask):
            return Pilots.of_profile(self.bundle.profile, self.bundle.levels(levels), mask)
        if levels not in self._pilots:
            # Two threads may both do this; the results are equal and either may stay.
            own, phases = self.bundle.pilot_mask, self.bundle.pilot_phases
            self._pilots[levels] = (
                Pilots.of_profile(self.bundle.profile, self.bundle.levels(levels), own)
                if phases is None
                else Pilots(own, self.bundle.modulation.phase(phases.astype(np.float64)))
            )
        return self._pilots[levels]

    def check(self, pair: FramePair, subject: str = "") -> None:
        """Check a frame pair against the camera of this bundle; `subject` goes before a frame's name in the error.

        Raises:
            FrameError: wrong size, type or bit depth, black or saturated.
        """
        check_pair(pair, subject)
        shape, dtype = self.bundle.profile.frame_shape, self.bundle.manifest.frame_dtype
        for name, frame in (("in-phase frame", pair.in_phase), ("quadrature frame", pair.quadrature)):
            name = subject + name
            if not isinstance(frame, np.ndarray) or frame.shape != shape:
                raise FrameError(name, f"shape {getattr(frame, 'shape', type(frame).__name__)}", f"shape {shape}")
            if frame.dtype != np.dtype(dtype):
                raise FrameError(name, f"type {frame.dtype}", dtype)
            check_light(name, frame, self.bundle.manifest.camera_bit_depth)

    def infer(
        self,
        pair: FramePair,
        table: SamplingTable | None = None,
        pilots: Pilots | None = None,
        *,
        doubtful: bool = False,
        alone: bool = False,
        limit: StepLimit | None = None,
    ) -> Inference:
        """Run the graph on a checked pair, together with other callers' where pages are computed in batches.

        Args:
            pair: both frames, as `check` accepts them.
            table: tensors for this page alone, of `PAGE_INPUTS`; all others take `with_table`.
            pilots: known symbols of the page, those of 256 levels if left out; an estimator takes the piston off by
                them.
            doubtful: whether frames with a residual beyond the bundle's limit are taken too.
            alone: whether it is computed by itself, as exactly as the golden page says.
            limit: limit on the time of an estimator's steps; pages of a batch get all of them.

        Raises:
            InvalidInputError: a table that does not fit.
            FrameError: the frames have a residual beyond the bundle's limit (then it is a `FramesDisagreeError`), or
                show no page.
        """
        table = table or {}
        self.graph.check(table)
        if others := set(table) - PAGE_INPUTS:
            raise InvalidInputError("table of a page", ", ".join(sorted(others)), f"only {', '.join(PAGE_INPUTS)}")
        page = None if alone else self.batches.infer(self.graph, pair, table.get(REGISTRATION))
        if page is None:
            feeds = {"in_phase": pair.in_phase, "quadrature": pair.quadrature, **table}
            if self._estimates and pilots is not None:
                feeds |= pilot_tensors(pilots)
            names = [*self._outputs, *(_OF_ESTIMATE if self._estimates else ())]
            with self.batches.alone:
                page = _page_of(self.graph, names, feeds, self.bundle, limit, alone=alone)
        check_residual(page.residual, self.bundle.manifest, doubtful=doubtful)
        return self.view.seen(page, table.get(REGISTRATION))

    @cached_property
    def field_solver(self) -> BundleFieldSolver:
        """Recovers fields as this bundle does.

        Raises:
            BundleError: no graph of the bundle shows the field.
        """
        return BundleFieldSolver(self.bundle, self.graph, self.threads)

    @cached_property
    def view(self) -> CameraView:
        """Says which symbols the cameras show."""
        ports, told = self.graph.ports, ("registration", "places")
        values = [self.graph.value(name) for name in told] if ports.keys() >= set(told) else None
        return CameraView(self.bundle.profile, *(values or (None, None)), measured=self._estimates)

    @cached_property
    def phase_refit(self) -> PhaseRefit:
        """Takes smooth phase errors off this device's pages."""
        positions = self.graph.value("positions") if "positions" in self.graph.ports else None
        return PhaseRefit(self.bundle.profile.page_shape, positions)

    @cached_property
    def page_codec(self) -> PageCodec:
        """Takes user bytes off this device's pages.

        Raises:
            BundleError: the bundle has no code, or one that does not fit its page.
        """
        if self.bundle.code is None:
            raise NoCodeError(f"{self.bundle.subject}: code", "none", "one, as `lightpage code --out-bundle` adds it")
        with raised_as(BundleError, InvalidInputError, about=f"{self.bundle.subject}: "):
            return self.codec_of(self.bundle.code)

    def codec_of(self, code: Code) -> PageCodec:
        """Codec of this device's pages with a code that fits them. It also reads pages of the bundle's own codes."""
        from lightpage.codec.page_codec import PageCodec

        bundle = self.bundle
        threads = self.code_threads
        codes = [*bundle.earlier_codes, *([] if bundle.code is None else [bundle.code])]
        own = [each for each in codes if each.levels == code.levels]  # others have other pilots
        codecs = [PageCodec(each, bundle.pilot_mask, bundle.levels(each.levels), threads) for each in own]
        return PageCodec(code, bundle.pilot_mask, bundle.levels(code.levels), threads, codecs)

    def written_pilots(self, levels: int) -> Pilots:
        """The pilots of pages that were written at `levels` levels, each on one of them.

        Raises:
            PageError: a level count outside 2..256.
        """
        written, shown = self.bundle.written_pilots(levels), self.bundle.levels(levels)
        return Pilots(self.bundle.pilot_mask, shown.phases[written])

    def decode(
        self, pair: FramePair, levels: int = 256, pilots: Pilots | None = None, limit: StepLimit | None = None
    ) -> DecodedPage:
        """Decode a frame pair into symbols of `levels` levels.

        Args:
            pair: both frames.
            levels: M, 2..256.
            pilots: the known symbols of this page, where they differ from this device's pattern.
            limit: see `infer`.

        Raises:
            FrameError, PageError: see `check`, `check_levels` and `infer`.
        """
        start = time.perf_counter()
        check_levels(levels)
        with self.batches.under_way():
            self.check(pair)
            checked = time.perf_counter()
            inference = self.infer(pair, pilots=pilots or self.pilots(levels), limit=limit)
            inferred = time.perf_counter()
            page = self.post_process(inference, levels, pilots)
        waited, behind = inference.waited_s, time.perf_counter() - inferred
        timings = Timings(checked - start, inferred - checked - waited, behind, waiting_s=waited)
        return replace(page, timings=timings.with_steps(inference))

    def post_process(self, inference: Inference, levels: int, pilots: Pilots | None = None) -> DecodedPage:
        """Piston, crosstalk, smooth phase error, flicker, trust, decision: all behind the graph; timings are zero."""
        known, shown = pilots or self.pilots(levels), self.bundle.levels(levels)
        page = corrected(inference.phase, inference.concentration, shown, known, self.phase_refit)
        symbols, confidence = decide_with_confidence(page.phase, page.concentration, shown)
        return DecodedPage(
            symbols=symbols,
            confidence=confidence,
            concentration=page.concentration,
            phase=page.phase,
            levels=levels,
            piston_rad=inference.whole_piston(page.reading.piston.angle_rad),
            brightness=inference.brightness,
            pilot_coherence=page.reading.piston.coherence,
            pilot_trust=page.reading.trust,
            check=page.reading.check,
            timings=Timings(0.0, 0.0, 0.0),
            phase_error=page.error,
            level_phases=shown.uneven,
            stroke_relative=page.stroke_relative,
        )

    def _check_golden(self) -> None:
        def answer(pair: FramePair) -> NDArray[np.float32]:
            self.check(pair)
            return self.infer(pair, alone=True).p

        check_golden(self.bundle, answer, self.bundle.manifest.precision)


_OF_ESTIMATE = ("nuisance", RESIDUAL)
"""Further outputs of an estimator."""


def _page_of(
    graph: PageGraph,
    names: list[str],
    feeds: dict[str, NDArray[Any]],
    bundle: Bundle,
    limit: StepLimit | None,
    *,
    alone: bool,
) -> Inference:
    """Run a graph on a page.

    Chi-square belongs to the estimate before the last step. With few steps it may exceed the limit for right frames.
    Such a page is estimated again with all steps of the bundle, and judged by them; where there is no time for that, it
    is left to its pilots.
    """
    residual = bundle.manifest.residual_output
    if not isinstance(graph, EstimatorGraph):
        run = graph.run_whole if alone else graph.run
        return _inference(dict(zip(names, run(names, feeds), strict=True)), residual)
    most = graph.most_steps if alone else graph.steps
    steps = most if limit is None else graph.times.steps_within(limit.seconds_left(), limit.least, most)
    page = _inference(dict(zip(names, graph.run(names, feeds, steps), strict=True)), residual)
    largest = bundle.manifest.residual_limit
    page = replace(page, steps=steps, skipped_steps=most - steps)
    if largest is None or not page.residual > largest or steps == graph.most_steps:
        return page
    if page.skipped_steps:
        return replace(page, residual=largest)
    whole = _inference(dict(zip(names, graph.run_whole(names, feeds), strict=True)), residual)
    return replace(whole, steps=steps + graph.most_steps)


def _inference(found: dict[str, NDArray[np.float32]], residual: str | None) -> Inference:
    """The inference of a graph's outputs by name."""
    p, phase, concentration = (found[name] for name in OUTPUTS)
    page = Inference(p, phase, concentration, float(np.max(found[residual])) if residual else 0.0)
    if "nuisance" not in found:
        return page
    tilt, shift = found["nuisance"][2:4], found["nuisance"][4:6]
    drift = np.concatenate([shift, tilt]).astype(np.float64)
    # the counts of a reference alone are as expected of a page without light
    has_light = bool(np.isfinite(found[RESIDUAL]).all())
    gain = complex(*found["nuisance"][:2].astype(np.float64))
    return replace(page, drift=drift, gain=gain, residual=page.residual if has_light else np.nan)


def _like(decoder: Decoder, bundle: Bundle, graph: PageGraph) -> Decoder:
    """The decoder of the same graphs with another table; whatever is open is shared."""
    codes, batching, batches = decoder.code_threads, decoder._batching, decoder.batches
    return Decoder(
        bundle, decoder.threads, graph, code_threads=codes, batching=batching, batches=batches, steps=decoder.steps
    )
