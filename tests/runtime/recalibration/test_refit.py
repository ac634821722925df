"""The real re-fit on the shipped bundle: it starts where the image is found, and refuses what is no small drift."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from lightpage.calibration.calibrate import LEAST_KEPT, Registered
from lightpage.device.state import Device
from lightpage.errors import CalibrationError
from lightpage.page.symbols import random_symbols
from lightpage.simulator.simulator import Simulator
from runtime.bundle.bundle import Bundle, npz
from runtime.bundle.calibrated import calibration_of
from runtime.bundle.manifest import TABLE
from runtime.bundle.shipped import DEFAULT, bundle_path
from runtime.decoding.decoder import Decoder
from runtime.recalibration import refit as module
from runtime.recalibration.known_pages import KnownPages
from runtime.recalibration.outcome import RefitResult
from runtime.recalibration.refit import refit
from tests.runtime.recalibration.toy_worker import quiet

LEVELS = 256
QUIET = Device().with_settings(["drift.shift_px=0.0"])


@pytest.fixture(scope="module")
def bench() -> Decoder:
    return Decoder.load(bundle_path(DEFAULT), threads=1)


@pytest.fixture(scope="module")
def moved(bench: Decoder) -> KnownPages:
    """A page whose image lies further off than a search reaches from where calibration saw it."""
    written = random_symbols(bench.bundle.profile, LEVELS, 1, np.random.default_rng(8))
    simulator = Simulator(bench.bundle.profile, QUIET, LEVELS, 8)
    simulator.knock((-2.0, 18.0))
    return KnownPages((simulator.page(written[0]),), (written[0],), LEVELS, simulator.references(), None, (-1.0, 9.0))


def with_calibration(bundle: Bundle, text: str) -> Bundle:
    return replace(bundle, manifest=bundle.manifest.model_copy(update={"calibration": text}))


Refined = Callable[..., RefitResult]


@pytest.fixture
def refined(bench: Decoder, moved: KnownPages, monkeypatch: pytest.MonkeyPatch) -> Refined:
    """A re-fit whose search of the parameters ends where it starts, with a coherence, or finds nothing."""

    def run(pages: KnownPages = moved, coherence: float | None = 1.0, bundle: Bundle = bench.bundle) -> RefitResult:
        def fitted(*_: object, start: np.ndarray, quadrature_phase: float, **__: object) -> Registered:
            if coherence is None:
                raise CalibrationError("known pages", "nothing", "the right symbols")
            return Registered(start, np.ones(len(start)), quadrature_phase, 0.0, coherence, 1.0, 0.5)

        monkeypatch.setattr(module, "refine", fitted)
        return refit(bundle, pages, quiet, bench)

    return run


def test_a_re_fit_starts_where_the_image_is_found(refined: Refined, bench: Decoder, moved: KnownPages) -> None:
    found = refined()
    assert found.report.image is not None
    assert (found.report.image.shift_x_px, found.report.image.shift_y_px) == pytest.approx((-2, 18), abs=0.3)
    old = calibration_of(bench.bundle)
    new = calibration_of(with_calibration(bench.bundle, found.calibration_toml))
    changed = {name: new.parameters[name] - old.parameters[name] for name in old.parameters}
    for camera in ("in_phase", "quadrature"):
        shifts = [changed.pop(f"{camera}_shift_{axis}_px") for axis in "xy"]
        assert shifts == pytest.approx((-2, 18), abs=0.3)
    assert not any(changed.values())
    assert new.reference_coherence == old.reference_coherence
    assert found.table.keys() <= bench.graph.ports.keys()
    assert moved.references is not None
    assert np.array_equal(found.table["reference_in_phase"], moved.references.in_phase)
    assert np.array_equal(found.table["reference_quadrature"], moved.references.quadrature)


def test_small_losses_do_not_add_up_unseen(refined: Refined, bench: Decoder) -> None:
    """A re-fit is measured by the first calibration, and not by the one before."""
    late = calibration_of(bench.bundle).model_copy(update={"coherence_at_first": 1.0})
    bundle = with_calibration(bench.bundle, late.to_toml())
    found = refined(coherence=LEAST_KEPT, bundle=bundle)
    assert found.report.coherence_after == LEAST_KEPT
    assert calibration_of(with_calibration(bundle, found.calibration_toml)).reference_coherence == 1.0
    with pytest.raises(CalibrationError, match="re-fit, outcome"):
        refined(coherence=LEAST_KEPT - 1e-3, bundle=bundle)


def test_what_fits_nothing_is_told_with_whether_the_image_was_found(refined: Refined, moved: KnownPages) -> None:
    with pytest.raises(CalibrationError, match="known pages"):
        refined(coherence=None)
    with pytest.raises(CalibrationError, match="re-fit"):
        refined(replace(moved, symbols=(moved.symbols[0][::-1],)), coherence=None)


def test_earlier_reference_frames_hold_where_none_were_taken(
    refined: Refined, bench: Decoder, moved: KnownPages
) -> None:
    assert moved.references is not None
    with pytest.raises(CalibrationError, match="no reference frames"):
        refined(replace(moved, references=None))
    kept = npz(reference_in_phase=moved.references.in_phase, reference_quadrature=moved.references.quadrature)
    bundle = replace(bench.bundle, files={**bench.bundle.files, TABLE: kept})
    found = refined(replace(moved, references=None), bundle=bundle)
    assert np.array_equal(found.table["reference_quadrature"], moved.references.quadrature)


