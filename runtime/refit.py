"""Re-fits the device's geometry with the exported twin and re-traces the sampling table."""

from __future__ import annotations

import numpy as np

from optics.errors import BundleError, CalibrationError
from optics.page import symbol_phases
from optics.progress import Progress
from optics.recording import FramePair, hash_frames
from optics.registration.calibrate import LEAST_KEPT, KnownPage, refine
from optics.registration.calibration import Calibration
from optics.registration.table import sampling_table
from runtime.bundle import Bundle
from runtime.calibrated import calibration_of
from runtime.decoder import Decoder
from runtime.recalibration import FitReport, FitResult, KnownPages
from runtime.twin import OnnxTwin

_REFITTED = frozenset({"places", "parameters"})
"""Inputs that a re-fitted geometry is fed to, by one of which a decoder knows it."""
_TWIN_THREADS = 1
"""The twin traces few points at a time; a second thread would only spin."""


def refit(bundle: Bundle, pages: KnownPages, progress: Progress, decoder: Decoder) -> FitResult:
    """Fit on `pages`, starting from the bundle's calibration.

    The table holds the re-traced geometry and the reference frames that it was fitted with.

    Args:
        bundle: whose calibration and twin.
        pages: known pages; the first finds the geometry, the coherences are the mean of all.
        progress: told of every stage.
        decoder: the bundle's, whose graph recovers the field.

    Raises:
        CalibrationError: the pages fit no geometry near the earlier calibration, there are no reference frames, or the
            bundle holds no calibration to start from.
        BundleError: the bundle's graphs do not show the field, or hold a geometry that cannot be fed instead.
    """
    profile, earlier = bundle.profile, calibration_of(bundle)
    if not _REFITTED & decoder.table_shapes.keys():
        among = f"{' or '.join(sorted(_REFITTED))} among them"
        wanted = f"{among}: this decoder holds its geometry itself; calibrate, train and export anew"
        raise BundleError(f"{bundle.thing}: table inputs", sorted(decoder.table_shapes), wanted)
    references = pages.references or _kept_references(bundle)
    if references is None:
        raise CalibrationError("re-fit", "no reference frames", "reference-only frames taken with the known pages")
    twin = OnnxTwin(bundle, _TWIN_THREADS)
    known = [
        KnownPage(pair, np.exp(1j * symbol_phases(symbols, pages.levels)))
        for pair, symbols in zip(pages.pairs, pages.symbols, strict=True)
    ]
    registered = refine(
        twin,
        decoder.recover_field,
        profile,
        references,
        known,
        start=earlier.vector,
        turn=earlier.turn_rad,
        progress=progress,
    )
    if registered.coherence_after < LEAST_KEPT * earlier.reference_coherence:
        raise CalibrationError(
            "re-fit, outcome",
            f"a coherence of {registered.coherence_after:.3f}",
            f"at least {LEAST_KEPT:.0%} of the {earlier.reference_coherence:.3f} when it was calibrated: this device, "
            "drifted a little; else calibrate anew",
        )
    hashes = [hash_frames(pair) for pair in pages.pairs]
    fitted = earlier.followed_by(Calibration.from_registered(registered, profile, hashes))
    table = {
        "reference_in_phase": references.in_phase,
        "reference_quadrature": references.quadrature,
        **sampling_table(twin, registered.parameters, registered.turn, profile),
    }
    return FitResult(
        table={name: value for name, value in table.items() if name in decoder.table_shapes},
        calibration_toml=fitted.to_toml(),
        report=FitReport(
            angle_deg=fitted.angle_deg(profile),
            coherence_before=fitted.coherence_before,
            coherence_after=fitted.coherence_after,
            details={"turn_deg": float(np.rad2deg(fitted.turn_rad)), "cost": fitted.cost},
        ),
    )


def _kept_references(bundle: Bundle) -> FramePair | None:
    kept = [bundle.table.get(name) for name in ("reference_in_phase", "reference_quadrature")]
    return None if kept[0] is None or kept[1] is None else FramePair(kept[0], kept[1])
