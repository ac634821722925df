"""Re-fits the device's geometry with the exported twin and re-traces the sampling table."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.calibrate import LEAST_KEPT, KnownPage, refine
from lightpage.calibration.document import BlemishCounts, Calibration
from lightpage.calibration.image_search import REACH_PX
from lightpage.calibration.interfaces import FieldSolver, Twin
from lightpage.calibration.likelihood.device_fit import AFTER_REGISTRATION, DeviceFit
from lightpage.calibration.likelihood.table import PIXEL_GAINS, launch_tensors
from lightpage.calibration.sampling_table import apart_inputs, moved_cameras, sampling_table
from lightpage.errors import BundleError, CalibrationError
from lightpage.page.pilots import Pilots
from lightpage.page.symbols import symbol_phases
from lightpage.progress import Progress, part, warn
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import hash_frames
from lightpage.recording.pixels.blemishes import UNIT_GAIN, Blemishes
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_drift import BundleSearch
from lightpage.runtime.model.decoding.image_position import ImagePosition
from lightpage.runtime.model.execution.estimator_graph import EstimatorGraph
from lightpage.runtime.model.execution.twin import OnnxTwin
from lightpage.runtime.recalibration.estimator import GraphLikelihood, measured_table
from lightpage.runtime.recalibration.known_pages import KnownPages
from lightpage.runtime.recalibration.recalibration import RefitReport, RefitResult

REFITTED = frozenset({"places", "parameters"})
"""Inputs that a re-fitted geometry is fed to, by one of which a decoder knows it."""
_BEFORE_NOISE = 0.9
"""Share of a re-fit's time after which the noise of an estimator is measured."""
_SEARCHED_SYMBOLS = 300
"""Known symbols by which the image is looked for: enough in any light that can be calibrated in, and soon done."""


def refit(
    bundle: Bundle,
    pages: KnownPages,
    progress: Progress,
    decoder: Decoder,
    twin: Twin | None = None,
    solve_field: FieldSolver | None = None,
) -> RefitResult:
    """Fit on `pages`, starting from the bundle's calibration, moved to where their image is found.

    The table holds the re-traced geometry and the reference frames that it was fitted with.

    Args:
        bundle: bundle with calibration and twin.
        pages: known pages; the first finds the geometry, and all of them refine it where the bundle reads by maximum
            likelihood. The coherences are the mean of all.
        progress: told of every stage.
        decoder: the bundle's, whose graph recovers the field.
        twin: twin of the bundle's profile; the bundle's own if left out.
        solve_field: recovers fields; the decoder's graph if left out.

    Raises:
        CalibrationError: the pages fit no geometry near the earlier calibration, or the bundle holds no calibration to
            start from.
        BundleError: the bundle's graphs do not show the field, or hold a geometry that cannot be fed instead.
    """
    profile, earlier = bundle.profile, bundle.calibration
    if not REFITTED & decoder.graph.ports.keys():
        among = f"{' or '.join(sorted(REFITTED))} among them"
        expected = f"{among}: this decoder holds its geometry itself; calibrate, train and export anew"
        raise BundleError(f"{bundle.subject}: table inputs", sorted(decoder.graph.ports), expected)
    graph = decoder.graph
    registration_share = AFTER_REGISTRATION if isinstance(graph, EstimatorGraph) else 1.0
    blemishes = blemishes_of(decoder, pages.references)
    references = blemishes.references
    twin = OnnxTwin(bundle) if twin is None else twin
    progress("find the image", 0.0)
    image = _find(decoder, twin, pages, references) if pages.near is None else None
    moved_px = pages.image_px if image is None else (image.shift_x_px, image.shift_y_px)
    known_place = image is not None or pages.near is not None
    start = moved_cameras(earlier.vector, np.array(moved_px)) if known_place else earlier.vector
    known = [
        KnownPage(blemishes.corrected(pair), np.exp(1j * symbol_phases(symbols, pages.levels)))
        for pair, symbols in zip(pages.pairs, pages.symbols, strict=True)
    ]
    try:
        registered = refine(
            twin,
            decoder.field_solver if solve_field is None else solve_field,
            profile,
            references,
            known,
            start=start,
            quadrature_phase=earlier.turn_rad,
            progress=part(progress, 0, registration_share),
            modulation=earlier.modulator,
            near=pages.near,
            judged=not isinstance(graph, EstimatorGraph),
        )
    except CalibrationError as error:
        if not known_place:
            near = f"an image within {REACH_PX:g} px of where it was last seen, else calibrate anew"
            expected = f"{error.expected}; {near}"
            raise CalibrationError("re-fit", f"no image of the first page; then {error.got}", expected) from None
        raise
    if registered.coherence_after < LEAST_KEPT * earlier.reference_coherence:
        raise CalibrationError(
            "re-fit, outcome",
            f"a coherence of {registered.coherence_after:.3f}",
            f"at least {LEAST_KEPT:.0%} of the {earlier.reference_coherence:.3f} when it was calibrated: this device, "
            "drifted a little; else calibrate anew",
        )
    hashes = dict.fromkeys([*map(hash_frames, pages.pairs), *pages.fitted])
    conditions = registered.conditions
    if not isinstance(graph, EstimatorGraph) or conditions is None:
        fitted = earlier.followed_by(Calibration.from_registered(registered, profile, [*hashes]))
        check_as_good(earlier, fitted)
        return traced(decoder, twin, references, fitted, image)
    without_blemishes = {name: blemishes.unit_gains for name in graph.ports if name == PIXEL_GAINS}
    likelihood = GraphLikelihood(graph.with_table(without_blemishes))
    fit = DeviceFit(
        likelihood,
        twin,
        profile,
        references,
        known,
        lambda share: part(progress, AFTER_REGISTRATION, _BEFORE_NOISE)("likelihood of all known pages", share),
    )
    refined, statistics = fit.refined(registered, conditions)
    counts = BlemishCounts.of(blemishes)
    fitted = earlier.followed_by(Calibration.from_registered(refined, profile, [*hashes], statistics, counts))
    check_as_good(earlier, fitted)
    mask = bundle.pilot_mask if pages.pilot_mask is None else pages.pilot_mask
    measured = measured_table(
        likelihood,
        twin,
        fitted.device(profile, references),
        known,
        statistics,
        mask,
        lambda share: part(progress, _BEFORE_NOISE, 1)("noise of the estimator", share),
    )
    result = traced(decoder, twin, references, fitted, image, blemishes.gains)
    return replace(result, table={**result.table, **measured})


def blemishes_of(decoder: Decoder, references: FramePair | None) -> Blemishes:
    """Return the cameras' blemishes: those of new references, or as the bundle has them.

    Graphs that take no gains read frames with their blemishes, and are fitted with them.
    """
    if PIXEL_GAINS not in decoder.graph.ports:
        references = references or decoder.references
        return Blemishes(np.full((2, *references.in_phase.shape), UNIT_GAIN, np.uint8), references)
    if references is None:
        return Blemishes(decoder.graph.value(PIXEL_GAINS), decoder.references)
    return Blemishes.of(references)


def check_as_good(earlier: Calibration, fitted: Calibration) -> None:
    """Check that a fit is not wrong, unless the calibration that it started from is known to be.

    Raises:
        CalibrationError: it is wrong.
    """
    if not earlier.is_wrong:
        fitted.check_good("re-fit, outcome", ": else calibrate anew")


def traced(
    decoder: Decoder,
    twin: Twin,
    references: FramePair,
    fitted: Calibration,
    image: ImagePosition | None = None,
    gains: NDArray[np.uint8] | None = None,
) -> RefitResult:
    """The table of a re-fitted geometry.

    Args:
        decoder: takes it.
        twin: twin of the bundle's profile.
        references: references that the geometry was fitted with.
        fitted: the geometry.
        image: where its image was found, None where it was not, or not looked for.
        gains: gains of the cameras' pixels, see `Blemishes`; as the decoder has them if left out.
    """
    profile = decoder.bundle.profile
    if not set(apart_inputs(fitted.vector)) <= decoder.graph.ports.keys():
        warn(f"{decoder.bundle.subject}: the cameras stand further apart than its decoder can take off; train anew")
    table = {
        "reference_in_phase": references.in_phase,
        "reference_quadrature": references.quadrature,
        **sampling_table(twin, fitted.vector, fitted.turn_rad, profile),
    }
    if gains is not None:
        table[PIXEL_GAINS] = gains
    if (statistics := fitted.statistics) is not None:
        table |= launch_tensors(profile, fitted.vector, statistics.conditions, fitted.modulator)
    return RefitResult(
        table=decoder.taken(table),
        calibration_toml=fitted.to_toml(),
        report=RefitReport(
            angle_deg=fitted.angle_deg(profile),
            coherence_before=fitted.coherence_before,
            coherence_after=fitted.coherence_after,
            image=image,
            goodness=fitted.goodness,
        ),
    )


def _find(decoder: Decoder, twin: Twin, pages: KnownPages, references: FramePair) -> ImagePosition | None:
    """Return the image position of the first page against the earlier calibration; None where no search finds it.

    It is looked for there and where the service saw it last.

    All symbols are known here, and an even share of them stands for all.
    """
    symbols, mask = pages.symbols[0], np.zeros(pages.symbols[0].size, bool)
    mask[:: max(1, mask.size // _SEARCHED_SYMBOLS)] = True
    pilots = Pilots.of_symbols(mask.reshape(symbols.shape), symbols, decoder.bundle.levels(pages.levels))
    around = np.array([(0.0, 0.0), pages.image_px])
    found = BundleSearch(decoder, twin).find(pages.pairs[0], pilots, around, references)
    x, y = map(float, found.shift_px)
    return ImagePosition(x, y, searched=True, found=True) if found.found else None
