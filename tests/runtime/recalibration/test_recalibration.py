"""A recalibration writes a better bundle beside the old one, or nothing; its re-fit starts where the image is found."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from lightpage.calibration.calibrate import LEAST_KEPT, Registered
from lightpage.device.state import Device
from lightpage.errors import (
    BundleError,
    CalibrationError,
    FrameError,
    InvalidInputError,
    PageError,
    RecalibrationRefusedError,
    UnconfirmedPageError,
)
from lightpage.page.symbols import random_symbols
from lightpage.progress import Progress
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import hash_frames
from lightpage.runtime.model.bundle.bundle import Bundle, npz
from lightpage.runtime.model.bundle.manifest import TABLE
from lightpage.runtime.model.bundle.shipped import DEFAULT, bundle_path
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.tracking import NoTracker
from lightpage.runtime.recalibration import refit as module
from lightpage.runtime.recalibration.judgement import JudgedPage, judge
from lightpage.runtime.recalibration.known_pages import KnownPages
from lightpage.runtime.recalibration.recalibration import (
    Refit,
    RefitReport,
    RefitResult,
    next_version,
    reading_share,
    recalibrate,
)
from lightpage.runtime.recalibration.refit import refit
from lightpage.simulator.simulator import Simulator
from tests.runtime import toy
from tests.runtime.recalibration.toy_worker import known, quiet, shuffled


def test_the_new_bundle_is_whole_better_and_has_its_history(decoder: Decoder, tmp_path: Path) -> None:
    pages = known()
    outcome = recalibrate(decoder, pages, tmp_path / "new", "toy-1+r1", toy.fit_references, quiet)
    assert outcome.air_after > outcome.air_before + 0.5
    assert (outcome.pages_used, outcome.pages_held_back) == (3, 2)
    new = Decoder.load(tmp_path / "new", threads=1)
    assert new.version == "toy-1+r1"
    assert new.bundle.files["decoder.onnx"] == decoder.bundle.files["decoder.onnx"]
    assert set(new.bundle.table) == {"reference_in_phase", "reference_quadrature"}
    assert new.bundle.manifest.calibration == "angle_deg = 0.5\n"
    assert new.bundle.manifest.calibrated_pages == tuple(map(hash_frames, pages.pairs))
    assert (new.decode(pages.pairs[2], 16).symbols == pages.symbols[2]).all()


def test_a_second_recalibration_keeps_what_the_first_found(decoder: Decoder, tmp_path: Path) -> None:
    recalibrate(decoder, known(), tmp_path / "1.zip", "toy-1+r1", toy.fit_references, quiet)
    first = Decoder.load(tmp_path / "1.zip", threads=1)

    def gain_only(*_: object) -> RefitResult:
        return RefitResult({"homodyne": np.array([5.7, 1.0], np.float32)}, "x = 1\n", RefitReport())

    recalibrate(first, known(), tmp_path / "2.zip", "toy-1+r2", gain_only, quiet)
    assert set(Bundle.open(tmp_path / "2.zip").table) == {"homodyne", "reference_in_phase", "reference_quadrature"}


finds_nothing = Mock(
    side_effect=CalibrationError("known pages", "no significant peak", "a device within the capture range")
)


def leads_away(*_: object) -> RefitResult:
    return RefitResult({"reference_in_phase": np.full(toy.SHAPE, 140, np.float32)}, "x = 1\n", RefitReport())


@pytest.mark.parametrize(
    ("pages", "fit", "subject"),
    [
        (shuffled(known(), slice(None)), toy.fit_references, "re-fitted geometry"),
        (shuffled(known(), slice(2, None)), toy.fit_references, "re-fitted geometry"),
        (known(), finds_nothing, "known pages"),
        (known(toy.OFFSETS), leads_away, "re-fitted geometry"),
    ],
    ids=["wrong symbols", "wrong symbols of a page", "nothing found", "worse than before"],
)
def test_what_is_not_as_good_is_refused_and_nothing_is_written(
    pages: KnownPages, fit: Refit, subject: str, decoder: Decoder, tmp_path: Path
) -> None:
    with pytest.raises(RecalibrationRefusedError) as error:
        recalibrate(decoder, pages, tmp_path / "n.zip", "toy-1+r1", fit, quiet)
    assert error.value.subject == subject
    assert list(tmp_path.iterdir()) == []


class Follows(NoTracker):
    """Follows the cameras' offsets, which it has learnt, whatever the model in service says of them."""

    def __init__(self, decoder: Decoder, learnt: FramePair) -> None:
        table = {
            "reference_in_phase": learnt.in_phase.astype(np.float32),
            "reference_quadrature": learnt.quadrature.astype(np.float32),
        }
        super().__init__(decoder.with_table(table))
        self._learnt = learnt

    def fork(self) -> Follows:
        return self

    def refitted(self, decoder: Decoder) -> Follows:
        return Follows(decoder, self._learnt)


def test_both_models_are_judged_as_the_tracker_decodes(decoder: Decoder, tmp_path: Path) -> None:
    def a_little_off(bundle: Bundle, pages: KnownPages, *rest: object) -> RefitResult:
        found = toy.fit_references(bundle, pages, *rest)  # type: ignore[arg-type]
        table = {name: values - 4 for name, values in found.table.items()}
        return RefitResult(table, found.calibration_toml, found.report)

    pages = known()
    assert pages.references is not None
    plain = recalibrate(decoder, pages, tmp_path / "1.zip", "toy-1+r1", a_little_off, quiet, NoTracker(decoder))
    tracker = Follows(decoder, pages.references)
    outcome = recalibrate(decoder, pages, tmp_path / "2.zip", "toy-1+r2", a_little_off, quiet, tracker)
    assert outcome.air_before == outcome.air_after
    assert plain.air_before < outcome.air_before - 0.1
    assert plain.air_after < outcome.air_after - 0.01


def test_a_version_that_is_none_is_refused_before_the_fit(decoder: Decoder, tmp_path: Path) -> None:
    never = Mock(side_effect=AssertionError("fitted"))
    for version in ("v 2", "", "+r1", "x" * 101):
        with pytest.raises(BundleError, match="version"):
            recalibrate(decoder, known(), tmp_path / "n.zip", version, never, quiet)
    assert list(tmp_path.iterdir()) == []


def test_who_stops_the_work_at_a_step_finds_nothing_left_behind(decoder: Decoder, tmp_path: Path) -> None:
    def interrupt(step: str, share: float) -> None:
        if step == "write the new bundle":  # the last one
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        recalibrate(decoder, known(), tmp_path / "n.zip", "toy-1+r1", toy.fit_references, interrupt)
    assert list(tmp_path.iterdir()) == []


def test_progress_is_in_proportion_to_the_work(decoder: Decoder, tmp_path: Path) -> None:
    """A page is worth the same before and after the fit, and the fit as much as twenty of them."""
    told = list[tuple[str, float]]()

    def fit(bundle: Bundle, pages: KnownPages, progress: Progress, own: Decoder) -> RefitResult:
        progress("fit", 0.0)
        progress("fit", 1.0)
        return toy.fit_references(bundle, pages, quiet, own)

    recalibrate(decoder, known(count=3), tmp_path / "n.zip", "toy-1+r1", fit, lambda *step: told.append(step))
    names = ["measure the model in service", "fit", "judge by the held-back pages", "write the new bundle"]
    assert list(dict.fromkeys(name for name, _ in told)) == names
    shares = sorted({round(share * 25, 6) for _, share in told})
    assert shares == pytest.approx([0, 1, 2, 22, 23, 24])
    assert [share for _, share in told] == sorted(share for _, share in told)
    assert (reading_share(3), reading_share(0)) == (3 / 28, 0)


GOOD = known()
SMALL = FramePair(*2 * (np.zeros((2, 2), np.uint8),))


@pytest.mark.parametrize(
    ("pages", "error", "named"),
    [
        (known(count=1), InvalidInputError, "pages to recalibrate"),
        (KnownPages(GOOD.pairs, GOOD.symbols[:2], 16), InvalidInputError, "2 pages of"),
        (KnownPages(GOOD.pairs, GOOD.symbols, 8), PageError, "known page 0"),
        (KnownPages(GOOD.pairs, tuple(s[:4] for s in GOOD.symbols), 16), PageError, "known page 0"),
        (KnownPages((GOOD.pairs[0], SMALL), GOOD.symbols[:2], 16), FrameError, "known page 1"),
        (replace(GOOD, references=SMALL), FrameError, "reference: "),
        (KnownPages((*GOOD.pairs[:2], GOOD.pairs[1]), GOOD.symbols, 16), InvalidInputError, "known page 2"),
    ],
)
def test_unusable_pages_are_named(
    pages: KnownPages, error: type[Exception], named: str, decoder: Decoder, tmp_path: Path
) -> None:
    with pytest.raises(error, match=named):
        recalibrate(decoder, pages, tmp_path / "n.zip", "toy-1+r1", toy.fit_references, quiet)
    assert list(tmp_path.iterdir()) == []


def test_pages_without_light_are_left_out_while_enough_are_left(decoder: Decoder) -> None:
    dark = FramePair(*2 * (np.zeros(toy.SHAPE, np.uint8),))
    lit = replace(GOOD, pairs=(dark, *GOOD.pairs[1:])).lit(8)
    assert lit.pairs == GOOD.pairs[1:]
    assert all(one is other for one, other in zip(lit.symbols, GOOD.symbols[1:], strict=True))
    with pytest.raises(FrameError, match="known page 1"):
        replace(GOOD, pairs=(dark, dark, GOOD.pairs[2])).lit(8)


def test_versions_count_up_from_the_latest_that_exists() -> None:
    assert next_version("bench-1") == "bench-1+r1"
    assert next_version("bench-1+r9") == "bench-1+r10"
    # r1 has been dropped from a full store, or rolled back to: its number is not given twice
    assert next_version("bench-1", ["bench-1+r2", "bench-1+r10", "other+r70", "bench-1"]) == "bench-1+r11"
    assert next_version("bench-1+r1", ["bench-1+r2"]) == "bench-1+r3"


def judged(change: float, scatter: float, drifted: bool) -> tuple[list[JudgedPage], list[JudgedPage]]:
    """Two held-back pages before and after; the difference has this mean, and this scatter from symbol to symbol."""
    rng = np.random.default_rng(4)
    old = rng.normal(3.0, 1.0, (2, 4000))
    noise = rng.normal(0.0, scatter, old.shape)
    new = old + change + noise - noise.mean()
    return [JudgedPage(page, None, drifted) for page in old], [JudgedPage(page, None, drifted) for page in new]


@pytest.mark.parametrize(
    ("drifted", "change", "taken"),
    [
        *((True, change, change > -1) for change in (-1.1, -0.9, 0.0, 1.0)),
        *((False, change, change > 2) for change in (-5.0, 0.0, 1.8, 2.2)),
    ],
)
def test_a_model_may_read_less_by_the_standard_error_or_must_gain_two_where_nothing_has_drifted(
    drifted: bool, change: float, taken: bool
) -> None:
    error = 0.3 / np.sqrt(8000)
    before, after = judged(change * error, 0.3, drifted)
    limit = np.mean([page.air for page in before]) + (-1 if drifted else 2) * error
    if not taken:
        with pytest.raises(RecalibrationRefusedError) as caught:
            judge(before, after, 256)
        told = float(caught.value.expected.removeprefix("at least ").partition(":")[0])
        assert told == pytest.approx(limit, abs=5e-4)
        return
    verdict = judge(before, after, 256)
    assert verdict.error == pytest.approx(error, rel=0.05)
    assert verdict.limit == pytest.approx(limit, abs=5e-4)
    assert verdict.after >= verdict.limit


def test_a_page_that_was_lost_before_counts_with_no_bits_and_one_that_is_lost_now_is_refused() -> None:
    before, after = judged(0.0, 0.0, drifted=False)
    lost = UnconfirmedPageError("pilots", "none", "some")
    verdict = judge([replace(page, lost=lost) for page in before], after, 256)
    assert (verdict.before, verdict.drifted) == (0.0, True)
    with pytest.raises(RecalibrationRefusedError, match="1 of 2"):
        judge(before, [after[0], replace(after[1], lost=lost)], 256)
    with pytest.raises(RecalibrationRefusedError, match="frame: got dark"):
        judge(before, [replace(after[0], lost=FrameError("frame", "dark", "light")), after[1]], 256)


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
    old = bench.bundle.calibration
    new = with_calibration(bench.bundle, found.calibration_toml).calibration
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


def test_a_re_fit_near_a_device_tells_no_search(refined: Refined, bench: Decoder, moved: KnownPages) -> None:
    near = bench.bundle.calibration.device(bench.bundle.profile, bench.references)
    found = refined(replace(moved, near=near, fitted=("a" * 64,)))
    assert found.report.image is None
    fitted = with_calibration(bench.bundle, found.calibration_toml).calibration
    assert fitted.calibrated_pages[-2:] == (hash_frames(moved.pairs[0]), "a" * 64)


def test_pages_that_earlier_fits_saw_do_not_judge(decoder: Decoder, tmp_path: Path) -> None:
    pages = known()
    seen = replace(pages, fitted=tuple(map(hash_frames, pages.pairs[:2])))
    outcome = recalibrate(decoder, seen, tmp_path / "new", "toy-1+r1", toy.fit_references, quiet)
    assert (outcome.pages_used, outcome.pages_held_back) == (3, 1)


def test_small_losses_do_not_add_up_unseen(refined: Refined, bench: Decoder) -> None:
    """A re-fit is measured by the first calibration, and not by the one before."""
    late = bench.bundle.calibration.model_copy(update={"coherence_at_first": 1.0})
    bundle = with_calibration(bench.bundle, late.to_toml())
    found = refined(coherence=LEAST_KEPT, bundle=bundle)
    assert found.report.coherence_after == LEAST_KEPT
    assert with_calibration(bundle, found.calibration_toml).calibration.reference_coherence == 1.0
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
    trained = refined(replace(moved, references=None)).table["reference_quadrature"]
    assert np.array_equal(trained, bench.references.quadrature)
    kept = npz(reference_in_phase=moved.references.in_phase, reference_quadrature=moved.references.quadrature)
    bundle = replace(bench.bundle, files={**bench.bundle.files, TABLE: kept})
    found = refined(replace(moved, references=None), bundle=bundle)
    assert np.array_equal(found.table["reference_quadrature"], moved.references.quadrature)
