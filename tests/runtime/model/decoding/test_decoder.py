"""The decoder finds the symbols, says how sure it is, and refuses models and frames that are not its own."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lightpage.calibration.document import parse_calibration
from lightpage.errors import BundleError, FrameError, InvalidInputError, PageError
from lightpage.metrics.measures import measure
from lightpage.page.pilots import Pilots
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.bundle.bundle import Bundle, npz, write_bundle
from lightpage.runtime.model.bundle.manifest import DECODER, GOLDEN, PILOTS, TABLE
from lightpage.runtime.model.bundle.shipped import bundle_path
from lightpage.runtime.model.decoding.decoder import Decoder
from tests.lightpage.uneven import UNEVEN, uneven
from tests.runtime import toy


def pair_of(levels: int = 16, seed: int = 1, piston: float = 0.0, **device: object) -> tuple[np.ndarray, FramePair]:
    symbols = toy.symbols_of(levels, seed)[0]
    return symbols, toy.ToyDevice(seed=seed, **device).page(symbols, levels, piston)  # type: ignore[arg-type]


@pytest.mark.parametrize("levels", [2, 3, 64])
def test_symbols_come_back_at_any_level_count(levels: int, decoder: Decoder) -> None:
    symbols, pair = pair_of(levels, noise=2.0)
    page = decoder.decode(pair, levels)
    assert page.symbols.dtype == np.uint8
    assert page.confidence.dtype == page.phase.dtype == page.concentration.dtype == np.float32
    assert (page.symbols == symbols).all()
    assert page.confidence.min() >= 1 / levels


@pytest.mark.parametrize("piston", [-3.0, 1.7])
def test_piston_is_found_and_removed(piston: float, decoder: Decoder) -> None:
    symbols, pair = pair_of(piston=piston)
    page = decoder.decode(pair, 16)
    assert np.angle(np.exp(1j * (page.piston_rad - piston))) == pytest.approx(0, abs=0.05)
    assert page.pilot_coherence > 0.98
    assert (page.symbols == symbols).all()
    assert np.abs(page.phase).max() <= np.float32(np.pi)


def test_confidence_is_the_share_that_is_right(tmp_path: Path) -> None:
    noise, seeds = 60.0, range(6)
    kappa = 16 * (toy.AMPLITUDE / noise) ** 2
    noisy = Decoder.load(toy.write_toy_bundle(tmp_path / "noisy.zip", kappa, residual_limit=5.0), threads=1)
    symbols, pairs = zip(*(pair_of(8, seed, noise=noise) for seed in seeds), strict=True)
    pages = [noisy.decode(pair, 8) for pair in pairs]
    figures = measure(
        np.stack([p.phase for p in pages]), np.stack([p.concentration for p in pages]), np.stack(symbols), 8
    )
    assert 0.01 < figures.symbol_error_rate < 0.3
    assert figures.ece < 0.05


def test_pilots_of_another_pattern_can_be_given(decoder: Decoder) -> None:
    symbols = np.random.default_rng(5).integers(16, size=toy.PAGE).astype(np.uint8)
    pair = toy.ToyDevice().page(symbols, 16, 2.0)
    mask = np.zeros(toy.PAGE, bool)
    mask[::5, ::5] = True
    assert (decoder.decode(pair, 16, pilots=Pilots.of_symbols(mask, symbols, 16)).symbols == symbols).all()
    assert (decoder.decode(pair, 16).symbols != symbols).mean() > 0.5


@pytest.mark.parametrize("levels", [4, 16, 256])
def test_the_devices_own_pilot_phases_hold_at_any_level_count(levels: int, tmp_path: Path) -> None:
    own = Decoder.load(toy.write_own_pilots_bundle(tmp_path / "own.zip"), threads=1)
    symbols = np.random.default_rng(5).integers(16, size=toy.PAGE).astype(np.uint8)
    pair = toy.own_pilots_page(toy.ToyDevice(noise=2.0), symbols, 16, 2.0)
    page = own.decode(pair, levels)
    assert page.pilot_coherence > 0.98
    assert page.piston_rad == pytest.approx(2.0, abs=0.02)
    assert own.pilots(levels).phases == pytest.approx(toy.OWN_PHASES)
    if levels == 16:
        assert (page.symbols == symbols)[~toy.OWN_MASK].all()


@pytest.mark.parametrize("levels", [16, 256])
def test_a_page_is_read_by_the_phases_that_its_modulator_shows(levels: int, tmp_path: Path) -> None:
    calibration = parse_calibration(Bundle.open(bundle_path("bench")).manifest.calibration)
    told = calibration.model_copy(update={"profile_name": "toy", "modulation": UNEVEN.as_dict()}).to_toml()
    contents = toy.files() | {PILOTS: npz(mask=toy.OWN_MASK, phases=toy.OWN_PHASES)}
    for files in (toy.files(), contents):
        path = write_bundle(tmp_path / f"{len(files)}.zip", toy.manifest(calibration=told), files)
        decoder = Decoder.load(path, threads=1)
        symbols = toy.symbols_of(levels, 3)[0]
        symbols[decoder.bundle.pilot_mask] = decoder.bundle.written_pilots(levels)
        pair = toy.ToyDevice(noise=0.3).page(symbols, uneven(levels), 1.0)
        page = decoder.decode(pair, levels, decoder.written_pilots(levels))
        assert (page.symbols == symbols).mean() > (0.999 if levels == 16 else 0.9)
        assert page.piston_rad == pytest.approx(1.0, abs=0.02)
        assert page.level_phases == uneven(levels).uneven
        assert decoder.decode(pair, levels).piston_rad == pytest.approx(1.0, abs=0.1)
    np.testing.assert_allclose(decoder.pilots(levels).phases, UNEVEN.phase(toy.OWN_PHASES.astype(float)))


def test_pilots_without_phases_follow_the_profiles_pattern_at_their_own_places(tmp_path: Path) -> None:
    older = Decoder.load(toy.write_own_pilots_bundle(tmp_path / "older.zip", mask=toy.OWN_MASK), threads=1)
    assert older.bundle.pilot_phases is None
    expected = Pilots.of_profile(toy.PROFILE, 16, toy.OWN_MASK)
    assert (older.pilots(16).mask == expected.mask).all()
    assert (older.pilots(16).phases == expected.phases).all()


@pytest.mark.parametrize(
    "phases", [toy.OWN_PHASES[1:], toy.OWN_PHASES.astype(np.float64), np.full_like(toy.OWN_PHASES, np.nan)]
)
def test_pilot_phases_that_do_not_fit_are_refused_when_loading(phases: np.ndarray, tmp_path: Path) -> None:
    path = toy.write_own_pilots_bundle(tmp_path / "odd.zip", mask=toy.OWN_MASK, phases=phases)
    with pytest.raises(BundleError, match="phases: got"):
        Decoder.load(path, threads=1)


def test_what_may_differ_from_page_to_page_is_fed_and_stays_as_it_was_without(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("decoding.decoder", "execution.page_graph"):
        monkeypatch.setattr(f"lightpage.runtime.model.{module}.PAGE_INPUTS", frozenset(["homodyne"]))
    default, bundled, fed = (np.array([gain, 1.0], np.float32) for gain in (400 / toy.AMPLITUDE, 2.0, 3.0))
    _, pair = pair_of()
    p = toy.expected_p(pair)
    golden = npz(in_phase=pair.in_phase, quadrature=pair.quadrature, p=p * (bundled[0] / default[0]))
    contents = toy.files() | {TABLE: npz(homodyne=bundled), GOLDEN: golden}
    decoder = Decoder.load(write_bundle(tmp_path / "t.zip", toy.manifest(), contents), threads=1)
    for table, gain in ((None, bundled), ({"homodyne": fed}, fed), (None, bundled)):
        np.testing.assert_allclose(decoder.infer(pair, table).p, p * (gain[0] / default[0]), rtol=1e-5, atol=1e-3)
    with pytest.raises(InvalidInputError, match=r"^table of"):
        decoder.infer(pair, {"reference_in_phase": np.full(toy.SHAPE, 150, np.float32)})


def test_the_table_in_a_bundle_is_used_and_its_golden_page_belongs_to_it(decoder: Decoder, tmp_path: Path) -> None:
    symbols, pair = pair_of(offsets=(150.0, 65.0))
    table = {
        "reference_in_phase": np.full(toy.SHAPE, 150, np.float32),
        "reference_quadrature": np.full(toy.SHAPE, 65, np.float32),
    }
    golden = npz(in_phase=pair.in_phase, quadrature=pair.quadrature, p=toy.expected_p(pair, offsets=(150.0, 65.0)))
    contents = toy.files() | {TABLE: npz(**table), GOLDEN: golden}
    moved = Decoder.load(write_bundle(tmp_path / "moved.zip", toy.manifest(), contents), threads=1)
    for one in (moved, decoder.with_table(table)):
        assert (one.decode(pair, 16).symbols == symbols).all()
    assert (decoder.decode(pair, 16).symbols != symbols).mean() > 0.05
    del contents[TABLE]
    with pytest.raises(BundleError, match=r"golden\.npz"):
        Decoder.load(write_bundle(tmp_path / "lost.zip", toy.manifest(), contents), threads=1)


@pytest.mark.parametrize(
    ("table", "named"),
    [
        ({"nonsense": np.zeros(2, np.float32)}, "nonsense"),
        ({"homodyne": np.zeros(3, np.float32)}, "homodyne"),
        ({"homodyne": np.array([1, np.nan], np.float32)}, "NaN"),
    ],
)
def test_a_table_that_does_not_fit_is_refused(
    table: dict[str, np.ndarray], named: str, decoder: Decoder, tmp_path: Path
) -> None:
    for use in (decoder.with_table, lambda table: decoder.infer(pair_of()[1], table)):
        with pytest.raises(InvalidInputError, match=named):
            use(table)
    if "homodyne" in table:
        with pytest.raises(BundleError, match=named):
            Decoder.load(write_bundle(tmp_path / "t.zip", toy.manifest(), toy.files() | {TABLE: npz(**table)}))


@pytest.mark.parametrize(
    ("frames", "named"),
    [
        ({"in_phase": np.full((64, 95), 100, np.uint8)}, r"in-phase frame: got shape \(64, 95\)"),
        ({"quadrature": np.full(toy.SHAPE, 100, np.uint16)}, "quadrature frame: got type uint16"),
        ({"quadrature": np.full(toy.SHAPE, 3, np.uint8)}, "quadrature frame: got black"),
        ({"quadrature": np.full(toy.SHAPE, 255, np.uint8)}, "quadrature frame: got saturated"),
    ],
)
def test_a_bad_frame_is_named(frames: dict[str, np.ndarray], named: str, decoder: Decoder) -> None:
    with pytest.raises(FrameError, match=named):
        decoder.decode(replace(pair_of()[1], **frames), 16)


def test_swapped_frames_are_noticed_by_their_residual(decoder: Decoder) -> None:
    pair = pair_of()[1]
    with pytest.raises(FrameError, match="swapped"):
        decoder.decode(FramePair(pair.quadrature, pair.in_phase), 16)


def test_counts_beyond_the_bit_depth_are_refused(tmp_path: Path) -> None:
    contents = toy.files() | {DECODER: toy.decoder_onnx(frame_type="uint16")}
    pair = pair_of()[1]
    wide = FramePair(pair.in_phase.astype(np.uint16), pair.quadrature.astype(np.uint16))
    contents[GOLDEN] = npz(in_phase=wide.in_phase, quadrature=wide.quadrature, p=toy.expected_p(pair))
    manifest = toy.manifest(frame_dtype="uint16", camera_bit_depth=12)
    decoder = Decoder.load(write_bundle(tmp_path / "twelve.zip", manifest, contents), threads=1)
    decoder.check(wide)
    wide.quadrature[3, 4] = 4096
    with pytest.raises(FrameError, match=r"quadrature frame: .*4096"):
        decoder.check(wide)


@pytest.mark.parametrize("levels", [1, 257])
def test_impossible_level_counts_are_refused(levels: int, decoder: Decoder) -> None:
    with pytest.raises(PageError, match="levels"):
        decoder.decode(pair_of()[1], levels)


def foreign_models() -> dict[str, tuple[dict[str, bytes], dict[str, object], str]]:
    good = toy.files()
    other_pair = toy.ToyDevice(seed=5).page(toy.symbols_of(16, 5)[0], 16)
    wrong_golden = npz(
        in_phase=other_pair.in_phase, quadrature=other_pair.quadrature, p=1.01 * toy.expected_p(other_pair)
    )
    black = npz(in_phase=np.zeros(toy.SHAPE, np.uint8), quadrature=other_pair.quadrature, p=toy.expected_p(other_pair))
    return {
        "garbage": (good | {DECODER: b"no model"}, {}, "ONNX"),
        "a twin": (good | {DECODER: toy.twin_onnx()}, {"table_inputs": ()}, r"decoder\.onnx: inputs"),
        "another camera": (good | {DECODER: toy.decoder_onnx(shape=(64, 128))}, {}, "input in_phase"),
        "another type": (good | {DECODER: toy.decoder_onnx(frame_type="uint16")}, {}, "input in_phase"),
        "other tables": (good, {"table_inputs": ("homodyne",)}, "table inputs"),
        "no residual": (good, {"residual_output": "rest"}, "rest"),
        "other weights": (good | {DECODER: toy.decoder_onnx(kappa=401)}, {}, "golden"),
        "other answer": (good | {GOLDEN: wrong_golden}, {}, "golden"),
        "black golden": (good | {GOLDEN: black}, {}, "golden"),
        "no golden": (good | {GOLDEN: b"junk"}, {}, "golden"),
        "no profile": (good, {"profile": "name = 'x'"}, "profile"),
    }


@pytest.mark.parametrize("kind", foreign_models())
def test_a_model_that_is_not_ours_is_refused(kind: str, tmp_path: Path) -> None:
    contents, changes, named = foreign_models()[kind]
    path = write_bundle(tmp_path / "foreign.zip", toy.manifest(**changes), contents)
    with pytest.raises(BundleError, match=named):
        Decoder.load(path, threads=1)


def test_many_threads_share_one_decoder(decoder: Decoder) -> None:
    pages = [pair_of(16, seed) for seed in range(8)]
    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(lambda page: decoder.decode(page[1], 16).symbols, pages * 4))
    assert all((got == want[0]).all() for got, want in zip(results, pages * 4, strict=True))
