"""A recalibration writes a better bundle beside the old one, or nothing."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lightpage.errors import (
    BundleError,
    CalibrationError,
    FrameError,
    InvalidInputError,
    PageError,
    RecalibrationRefusedError,
)
from lightpage.metrics.measures import measure
from lightpage.page.pilots import Pilots
from lightpage.progress import Progress
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.reader import hash_frames
from runtime.bundle.bundle import Bundle
from runtime.decoding.decoder import Decoder
from runtime.decoding.tracking import NoTracker
from runtime.errors import UnconfirmedPageError
from runtime.recalibration.judgement import JudgedPage, judge
from runtime.recalibration.known_pages import KnownPages
from runtime.recalibration.outcome import RefitReport, RefitResult
from runtime.recalibration.recalibration import next_version, recalibrate
from runtime.service.registry import ModelRegistry
from runtime.service.store import CURRENT, KEPT_BUNDLES, ModelStore
from tests.runtime import toy

DRIFTED = (150.0, 62.0)


def known(offsets: tuple[float, float] = DRIFTED, count: int = 3, levels: int = 16) -> KnownPages:
    device = toy.ToyDevice(offsets)
    symbols = toy.symbols_of(levels, 11, count)
    pairs = tuple(device.page(page, levels, 0.3) for page in symbols)
    return KnownPages(pairs, tuple(symbols), levels, device.references())


def quiet(step: str, share: float) -> None:
    """No progress."""


@pytest.mark.parametrize("name", ["new.zip", "new"])
def test_the_new_bundle_is_whole_better_and_has_its_history(name: str, decoder: Decoder, tmp_path: Path) -> None:
    pages = known()
    outcome = recalibrate(decoder, pages, tmp_path / name, "toy-1+r1", toy.fit_references, quiet)
    assert outcome.air_after > outcome.air_before + 0.5
    assert (outcome.pages_used, outcome.pages_held_back) == (3, 2)
    new = Decoder.load(tmp_path / name, threads=1)
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


def shuffled(pages: KnownPages, which: slice) -> KnownPages:
    symbols = list(pages.symbols)
    rng = np.random.default_rng(2)
    for index in range(*which.indices(len(symbols))):
        symbols[index] = rng.integers(16, size=toy.PAGE).astype(np.uint8)
    return KnownPages(pages.pairs, tuple(symbols), pages.levels, pages.references)


@pytest.mark.parametrize("which", [slice(None), slice(2, None)])
def test_wrong_pilots_are_refused_and_nothing_is_written(which: slice, decoder: Decoder, tmp_path: Path) -> None:
    with pytest.raises(RecalibrationRefusedError, match="held-back"):
        recalibrate(decoder, shuffled(known(), which), tmp_path / "n.zip", "toy-1+r1", toy.fit_references, quiet)
    assert list(tmp_path.iterdir()) == []


def test_a_fit_that_finds_nothing_is_a_refusal(decoder: Decoder, tmp_path: Path) -> None:
    def lost(*_: object) -> RefitResult:
        raise CalibrationError("known pages", "no significant peak", "a device within the capture range")

    with pytest.raises(RecalibrationRefusedError, match="capture range"):
        recalibrate(decoder, known(), tmp_path / "n.zip", "toy-1+r1", lost, quiet)
    assert list(tmp_path.iterdir()) == []


def test_a_table_worse_than_the_one_in_use_is_refused(decoder: Decoder, tmp_path: Path) -> None:
    def away(*_: object) -> RefitResult:
        table = {"reference_in_phase": np.full(toy.SHAPE, 140, np.float32)}
        return RefitResult(table, "x = 1\n", RefitReport())

    with pytest.raises(RecalibrationRefusedError, match="model in service"):
        recalibrate(decoder, known(toy.OFFSETS), tmp_path / "n.zip", "toy-1+r1", away, quiet)
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
    held_back, data = pages.part(slice(1, None)), ~decoder.bundle.pilot_mask
    shown = []
    for pair, symbols in zip(held_back.pairs, held_back.symbols, strict=True):
        page = tracker.decode(pair, 16, Pilots.of_symbols(~data, symbols, 16))
        shown.append(measure(page.phase[data], page.concentration[data], symbols[data], 16).air_bits_per_symbol)
    assert outcome.air_before == outcome.air_after == pytest.approx(np.mean(shown))
    assert plain.air_before < outcome.air_before - 0.1
    assert plain.air_after < outcome.air_after - 0.01


def test_a_version_that_is_none_is_refused_before_the_fit(decoder: Decoder, tmp_path: Path) -> None:
    def never(*_: object) -> RefitResult:
        raise AssertionError("fitted")

    for version in ("v 2", "", "+r1", "x" * 101):
        with pytest.raises(BundleError, match="version"):
            recalibrate(decoder, known(), tmp_path / "n.zip", version, never, quiet)
    assert list(tmp_path.iterdir()) == []


def test_an_interrupted_recalibration_leaves_nothing(decoder: Decoder, tmp_path: Path) -> None:
    def interrupt(step: str, share: float) -> None:
        if share >= 0.95:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        recalibrate(decoder, known(), tmp_path / "n.zip", "toy-1+r1", toy.fit_references, interrupt)
    assert list(tmp_path.iterdir()) == []


def test_no_step_is_told_once_the_bundle_is_written(decoder: Decoder, tmp_path: Path) -> None:
    """Whoever stops the work at a step finds nothing left behind."""
    out, steps = tmp_path / "n.zip", []

    def step(name: str, share: float) -> None:
        steps.append(name)
        assert not out.exists()

    recalibrate(decoder, known(), out, "toy-1+r1", toy.fit_references, step)
    assert out.exists()
    assert steps[-1] == "write the new bundle"


def test_every_page_that_is_judged_by_is_told_of_before_and_after_the_fit(decoder: Decoder, tmp_path: Path) -> None:
    told: dict[str, list[float]] = {}

    def step(name: str, share: float) -> None:
        told.setdefault(name, []).append(share)

    recalibrate(decoder, known(count=5), tmp_path / "n.zip", "toy-1+r1", toy.fit_references, step)
    before, after = told["measure the model in service"], told["judge by the held-back pages"]
    assert before == pytest.approx([0, 1 / 29, 2 / 29, 3 / 29])
    assert sorted(set(after)) == pytest.approx([24 / 29, 25 / 29, 26 / 29, 27 / 29])


@pytest.mark.parametrize("count", [2, 40])
def test_progress_is_in_proportion_to_the_work_however_many_pages_are_judged_by(
    count: int, decoder: Decoder, tmp_path: Path
) -> None:
    """A page is worth the same before and after the fit, and the fit as much as twenty of them."""
    told = list[tuple[str, float]]()

    def fit(bundle: Bundle, pages: KnownPages, progress: Progress, own: Decoder) -> RefitResult:
        progress("fit", 0.0)
        progress("fit", 1.0)
        return toy.fit_references(bundle, pages, quiet, own)

    recalibrate(decoder, known(count=count), tmp_path / "n.zip", "toy-1+r1", fit, lambda *step: told.append(step))
    assert [share for _, share in told] == sorted(share for _, share in told)
    fitted = [share for name, share in told if name == "fit"]
    (written,) = [share for name, share in told if name == "write the new bundle"]
    assert fitted[1] - fitted[0] == pytest.approx(20 / (count - 1) * fitted[0])
    assert written - fitted[1] == pytest.approx(fitted[0])


def test_unusable_pages_are_named(decoder: Decoder, tmp_path: Path) -> None:
    good, out = known(), tmp_path / "n.zip"
    cases: list[tuple[KnownPages, type[Exception], str]] = [
        (known(count=1), InvalidInputError, "at least 2"),
        (KnownPages(good.pairs, good.symbols[:2], 16), InvalidInputError, "2 pages of symbols"),
        (KnownPages(good.pairs, good.symbols, 8), PageError, "known page 0: symbols"),
        (KnownPages(good.pairs, tuple(s[:4] for s in good.symbols), 16), PageError, "known page 0: symbols"),
        (
            KnownPages((good.pairs[0], FramePair(*2 * (np.zeros((2, 2), np.uint8),))), good.symbols[:2], 16),
            FrameError,
            "shape",
        ),
        (
            KnownPages((*good.pairs[:2], good.pairs[1]), good.symbols, 16),
            InvalidInputError,
            "known page 2: got the frames of known page 1",
        ),
    ]
    for pages, kind, named in cases:
        with pytest.raises(kind, match=named):
            recalibrate(decoder, pages, out, "toy-1+r1", toy.fit_references, quiet)
    assert not out.exists()


def test_versions_count_up_from_the_latest_that_exists() -> None:
    assert next_version("bench-1") == "bench-1+r1"
    assert next_version("bench-1+r9") == "bench-1+r10"
    # r1 has been dropped from a full store, or rolled back to: its number is not given twice
    assert next_version("bench-1", ["bench-1+r2", "bench-1+r10", "other+r70", "bench-1"]) == "bench-1+r11"
    assert next_version("bench-1+r1", ["bench-1+r2"]) == "bench-1+r3"


def test_the_registry_keeps_a_bounded_number_and_refuses_other_devices(decoder: Decoder, tmp_path: Path) -> None:
    registry = ModelRegistry(decoder, kept=3)
    for number in range(2, 6):
        path = toy.write_toy_bundle(tmp_path / f"{number}.zip", version=f"toy-{number}")
        registry.swap(Decoder.load(path, threads=1))
    assert [model.version for model in registry.models] == ["toy-3", "toy-4", "toy-5"]
    with pytest.raises(BundleError, match="toy-4"):
        registry.swap(registry.models[1].decoder)
    assert registry.rollback()[0].version == "toy-4"


def test_a_full_store_drops_its_oldest_bundles_but_none_that_is_held(decoder: Decoder, tmp_path: Path) -> None:
    store = ModelStore(tmp_path / "store", decoder.bundle)
    paths = [store.path_of(f"toy-1+r{number}") for number in range(1, KEPT_BUNDLES + 4)]
    for age, path in enumerate(paths):
        path.write_bytes(b"")
        os.utime(path, (age, age))
    (given := store.folder / "bench.zip").write_bytes(b"")  # put there by someone else
    os.utime(given, (0, 0))
    assert set(store.prune([paths[1]])) == {paths[0], paths[2]}
    assert [path for path in paths if path.exists()] == [paths[1], *paths[3:]]
    assert given.exists()
    assert store.prune([paths[1]]) == []


def test_the_store_remembers_what_was_in_service_for_its_own_base_only(
    decoder: Decoder, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    store = ModelStore(tmp_path / "store", decoder.bundle)
    assert store.last() is None
    path = toy.write_toy_bundle(store.path_of("toy-1+r1"), version="toy-1+r1")
    store.remember(path)
    assert ModelStore(tmp_path / "store", decoder.bundle).last() == path
    assert store.versions() == ["toy-1+r1"]
    other = Bundle.open(toy.write_toy_bundle(tmp_path / "other.zip", version="other"))
    assert ModelStore(tmp_path / "store", other).last() is None
    store.remember(None)
    assert store.last() is None
    assert not caplog.records
    assert [file.name for file in store.folder.iterdir() if not file.name.endswith(".zip")] == [CURRENT]


def test_the_store_says_why_the_base_is_served_where_its_note_or_bundle_is_lost(
    decoder: Decoder, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    store = ModelStore(tmp_path / "store", decoder.bundle)
    store.remember(store.path_of("toy-1+r1"))
    note = store.folder / CURRENT
    base = store._base
    for content, why in (
        (note.read_text(), "toy-1+r1.zip: got no such file, wanted the bundle that was in service"),
        (json.dumps({"bundle": "../../etc/passwd", "base": base}), "got '../../etc/passwd', wanted the name"),
        (json.dumps({"bundle": 3, "base": base}), "got 3, wanted the name"),
        ("junk", "current.json: got JSONDecodeError"),
        ("[]", "current.json: got TypeError"),
        ('{"bundle": 3}', "current.json: got KeyError"),
    ):
        note.write_text(content)
        caplog.clear()
        assert store.last() is None
        assert [record.levelname for record in caplog.records] == ["WARNING"]
        assert f"serving the base: model store {store.folder}: " in caplog.text
        assert why in caplog.text


def judged(change: float, scatter: float, drifted: bool = True) -> tuple[list[JudgedPage], list[JudgedPage]]:
    """Two held-back pages before and after; the difference has this mean, and this scatter from symbol to symbol."""
    rng = np.random.default_rng(4)
    old = rng.normal(3.0, 1.0, (2, 4000))
    noise = rng.normal(0.0, scatter, old.shape)
    new = old + change + noise - noise.mean()
    return [JudgedPage(page, None, drifted) for page in old], [JudgedPage(page, None, drifted) for page in new]


@pytest.mark.parametrize(("change", "taken"), [(-1.1, False), (-0.9, True), (0.0, True), (1.0, True)])
def test_a_model_may_read_less_by_the_standard_error_of_the_comparison_at_most(change: float, taken: bool) -> None:
    scatter = 0.3
    error = scatter / np.sqrt(8000)
    before, after = judged(change * error, scatter)
    if not taken:
        with pytest.raises(RecalibrationRefusedError) as caught:
            judge(before, after, 256)
        told = float(caught.value.expected.removeprefix("at least ").partition(":")[0])
        assert told == pytest.approx(np.mean([page.air for page in before]) - error, abs=2e-4)
        return
    verdict = judge(before, after, 256)
    assert verdict.error == pytest.approx(error, rel=0.05)
    assert verdict.limit == pytest.approx(verdict.before - verdict.error)
    assert verdict.after >= verdict.limit


@pytest.mark.parametrize(("change", "taken"), [(-5.0, False), (0.0, False), (1.8, False), (2.2, True), (8.0, True)])
def test_a_model_of_a_device_that_has_not_drifted_stays_unless_something_is_gained(change: float, taken: bool) -> None:
    before, after = judged(change * 0.3 / np.sqrt(8000), 0.3, drifted=False)
    if taken:
        assert judge(before, after, 256).after > np.mean([page.air for page in before])
        return
    with pytest.raises(RecalibrationRefusedError):
        judge(before, after, 256)


def test_a_page_that_was_lost_before_counts_with_no_bits_and_as_a_drift() -> None:
    before, after = judged(0.0, 0.0, drifted=False)
    lost = UnconfirmedPageError("pilots", "none", "some")
    verdict = judge([replace(page, lost=lost) for page in before], after, 256)
    assert (verdict.before, verdict.drifted) == (0.0, True)
