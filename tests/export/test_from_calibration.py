"""A bundle of a calibration alone reads its device's pages, with as many steps as it is asked for."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from analysis.tracking import walking_device
from lightpage.calibration.document import Calibration, load_calibration
from lightpage.calibration.known_pages import known_pages
from lightpage.calibration.likelihood.known_page_fit import KnownPageFit
from lightpage.calibration.likelihood.measure import light_table
from lightpage.calibration.likelihood.table import FLAT_FIELD, pilot_tensors
from lightpage.calibration.waves.wave_fit import WaveFit
from lightpage.cli.simulate import simulate
from lightpage.codec.code import load_code
from lightpage.codec.page_codec import PageCodec
from lightpage.device.state import Device
from lightpage.errors import (
    BundleError,
    CalibrationError,
    FrameError,
    FramesDisagreeError,
    InvalidInputError,
    ProfileError,
)
from lightpage.export import estimated_device, from_calibration, proof
from lightpage.export.commands.calibrate import calibrate
from lightpage.export.from_calibration import export_calibration
from lightpage.metrics.measures import measure
from lightpage.page.correction import wrapped
from lightpage.page.pilots import Pilots
from lightpage.page.symbols import random_symbols
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.reader import Recording
from lightpage.recording.writer import RecordingWriter
from lightpage.runtime.archives.recordings.coded_pages import SeenPages, choose_code
from lightpage.runtime.archives.recordings.evaluation import unseen_pages
from lightpage.runtime.archives.run.job import Job
from lightpage.runtime.archives.run.task import Choices, NamedBundle, Operation
from lightpage.runtime.client.client import LightpageClient
from lightpage.runtime.commands.archives.code import code
from lightpage.runtime.commands.client.decode import page_report
from lightpage.runtime.console.last_pages import LastPages
from lightpage.runtime.model.bundle.bundle import Bundle, npz, write_bundle
from lightpage.runtime.model.bundle.manifest import (
    DECODER,
    EARLY,
    ESTIMATOR_FILES,
    FIRST,
    GOLDEN,
    OPERATORS,
    STEP,
    TWIN,
)
from lightpage.runtime.model.decoding.batches import Batching
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.runtime.model.decoding.page import Inference
from lightpage.runtime.model.execution.estimator_graph import EXPECTED, EstimatorFiles, EstimatorGraph
from lightpage.runtime.model.execution.session import open_session
from lightpage.runtime.model.execution.table_graph import GraphFile
from lightpage.runtime.model.execution.twin import OnnxTwin
from lightpage.runtime.recalibration.estimator import check_counts
from lightpage.runtime.recalibration.flat_field import flat_field_of
from lightpage.runtime.recalibration.known_pages import KnownPages
from lightpage.runtime.recalibration.noise import MOST_STEPS, KnownPhases, measured_noise
from lightpage.runtime.recalibration.recalibration import recalibrate
from lightpage.runtime.recalibration.refit import refit
from lightpage.runtime.service.assembly import assembled
from lightpage.runtime.service.server.server import LightpageServer
from lightpage.runtime.service.settings import ServiceSettings
from lightpage.simulator.simulator import Simulator
from lightpage.train.models.likelihood.estimator import PhaseEstimator
from lightpage.train.models.likelihood.torch_likelihood import TorchLikelihood
from tests.lightpage.command import run
from tests.lightpage.small import small_profile

USED = (0, 1)
STEPS = 3
PROFILE = small_profile()


@pytest.fixture(scope="module")
def calibration(small_device: list[str], small_bundle: Path) -> Calibration:
    right = load_calibration(small_device[5])
    with Recording.open(small_device[3]) as recording:
        pages, references = known_pages(recording, PROFILE, USED), recording.references()
        hashes = tuple(recording.page_hash(page) for page in USED)
    device, twin = right.device(PROFILE, references), OnnxTwin(Bundle.open(small_bundle))
    fit = WaveFit(twin, PROFILE, pages[0].pair, references, pages[0].symbols)
    conditions = fit.fit(device.parameters, device.quadrature_phase_rad, ("launch",), effort="once").conditions
    likelihood = TorchLikelihood(PhaseEstimator(PROFILE, device.parameters).eval())
    statistics = KnownPageFit(likelihood, light_table(twin, device, conditions), pages, device.modulation).statistics(
        conditions
    )
    return right.model_copy(update={"statistics": statistics, "calibrated_pages": hashes, "pages_used": len(hashes)})


@pytest.fixture(scope="module")
def bundle(
    calibration: Calibration, small_device: list[str], small_bundle: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    out, graph = tmp_path_factory.mktemp("estimator") / "estimator.zip", Bundle.open(small_bundle).files[TWIN]
    with pytest.MonkeyPatch.context() as patch, Recording.open(small_device[3]) as recording:
        patch.setattr(from_calibration, "twin_onnx", lambda twin: graph)
        export_calibration(calibration, recording, PROFILE, out, steps=STEPS)
    return out


def air(decoder: Decoder, recording: Path, pages: range) -> float:
    """AIR of some pages as a service reads them, bits a symbol."""
    tracker, bits = tracker_for(decoder), []
    with Recording.open(recording) as file:
        for number in pages:
            symbols, mask = file.symbols(number), decoder.bundle.pilot_mask
            assert symbols is not None
            known = Pilots.of_symbols(mask, symbols, 256)
            page = tracker.decode(file.frames(number), 256, known)
            data = page.phase[~mask], page.concentration[~mask], symbols[~mask]
            bits.append(measure(*data, 256).air_bits_per_symbol)
    return float(np.mean(bits))


def test_it_reads_more_than_a_short_training_and_each_step_reads_more(
    bundle: Path, small_bundle: Path, small_device: list[str]
) -> None:
    recording, unseen = Path(small_device[3]), range(2, 5)
    trained = air(Decoder.load(small_bundle), recording, unseen)
    by_steps = [air(Decoder.load(bundle, steps=steps), recording, unseen) for steps in (1, 2, STEPS)]
    assert by_steps[0] > trained
    assert by_steps == sorted(by_steps)
    assert by_steps[-1] > 6.2


def test_pages_that_the_fit_has_not_seen_judge_it(bundle: Path, small_device: list[str]) -> None:
    decoder = Decoder.load(bundle)
    reading = decoder.bundle.calibration.reading
    assert reading is not None
    assert not reading.in_sample
    read = air(decoder, Path(small_device[3]), range(len(USED), len(USED) + reading.pages))
    assert reading.air_bits == pytest.approx(read, abs=0.02)
    assert reading.light_bits == pytest.approx(read, abs=0.4)
    assert reading.user_bytes == decoder.page_codec.user_bytes
    assert reading.drift["piston_rad"] > 0
    assert reading.drift["image_x_px"] < 0.5


def test_one_graph_says_what_the_repeated_step_says(bundle: Path) -> None:
    decoder = Decoder.load(bundle)
    golden = decoder.bundle.golden
    whole = open_session(decoder.bundle.files[DECODER], DECODER, once=True)
    feeds = {"in_phase": golden.pair.in_phase, "quadrature": golden.pair.quadrature}
    (p,) = whole.run(["p"], feeds)
    repeated = decoder.infer(golden.pair).p
    assert np.linalg.norm(p - repeated) < 1e-3 * np.linalg.norm(p)


def test_a_first_step_that_predicts_light_finely_reads_more(
    bundle: Path, calibration: Calibration, small_device: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(estimated_device, "coarse_start_pays", lambda *device: False)
    out = tmp_path / "fine.zip"
    with Recording.open(small_device[3]) as recording:
        export_calibration(calibration, recording, PROFILE, out, steps=STEPS)
    coarse, fine = (Decoder.load(path, steps=1) for path in (bundle, out))
    recording_path = Path(small_device[3])
    assert air(fine, recording_path, range(4, 8)) > air(coarse, recording_path, range(4, 8)) + 0.1


def test_a_drifted_device_is_recalibrated_without_torch(bundle: Path, tmp_path: Path) -> None:
    drifted = Device().with_settings([f"geometry.pipe_angle_deg={Device().geometry.pipe_angle_deg + 0.05}"])
    simulator, rng = Simulator(PROFILE, drifted, seed=6), np.random.default_rng(6)
    symbols = tuple(random_symbols(PROFILE, 256, 3, rng))
    known = KnownPages(tuple(simulator.page(page) for page in symbols), symbols, 256, simulator.references())
    outcome = recalibrate(Decoder.load(bundle), known, tmp_path / "B.zip", "2", refit, lambda what, share: None)
    assert outcome.air_after > outcome.air_before + 0.3
    statistics = Bundle.open(tmp_path / "B.zip").calibration.statistics
    assert statistics is not None
    assert statistics != Bundle.open(bundle).calibration.statistics


def test_calibrations_of_before_and_of_other_pages_are_refused(
    calibration: Calibration, small_device: list[str], tmp_path: Path
) -> None:
    of_before = calibration.model_copy(update={"statistics": None})
    of_others = calibration.model_copy(update={"calibrated_pages": ("1" * 64,)})
    with Recording.open(small_device[3]) as recording:
        for wrong, subject in ((of_before, "statistics"), (of_others, "recording")):
            with pytest.raises(CalibrationError, match=subject):
                export_calibration(wrong, recording, PROFILE, tmp_path / "B.zip")
    assert not list(tmp_path.iterdir())


def test_a_services_models_take_no_more_steps_than_it_is_asked_for(
    bundle: Path, small_bundle: Path, small_device: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    steps = STEPS - 1
    table = {"bundle": str(bundle), "steps": steps, "threads": 1, "tracking": False}
    with Recording.open(small_device[3]) as recording:
        pair = recording.frames(2)
    with assembled(ServiceSettings.model_validate({"service": table}), LastPages()) as made:
        with LightpageServer(made.plane, made.recalibrator) as server, LightpageClient(server.target) as client:
            page = client.frames.decode(pair)
            assert page.timings.steps == steps
            assert page_report(page)["steps"] == steps
        base = made.plane.models.current.decoder
        assert base.decode(pair).timings.steps == steps
        network = base.of_another(Bundle.open(small_bundle))
        assert network.decode(pair).timings.steps == 0
        for later in (network.of_another(Bundle.open(bundle)), base.with_table({}), base.of_bundle(base.bundle)):
            assert later.infer(pair).steps == steps
        many = Decoder(base.bundle, 1, steps=STEPS + 4)
        assert many.infer(pair).steps == STEPS
    wrong = ServiceSettings.model_validate({"service": {**table, "steps": STEPS + 1}})
    refused = pytest.raises(InvalidInputError, match=f"steps: got {STEPS + 1}")
    with refused, assembled(wrong, LastPages()):
        pass
    with assembled(ServiceSettings.model_validate({"service": {**table, "bundle": str(small_bundle)}}), LastPages()):
        assert "network" in caplog.text


def test_a_followed_page_counts_the_steps_of_every_attempt(bundle: Path, small_device: list[str]) -> None:
    decoder = Decoder.load(bundle, 1, steps=2)
    with Recording.open(small_device[3]) as recording:
        page = tracker_for(decoder).decode(recording.frames(2), 256)
    assert page.timings.steps >= 2
    assert page.timings.steps % 2 == 0


def test_a_bulk_run_takes_the_steps_that_one_of_its_bundles_has(bundle: Path, small_bundle: Path) -> None:
    def run(steps: int, *paths: Path) -> Job:
        bundles = tuple(NamedBundle(path=path, sha256="0" * 64, version="1") for path in paths)
        return Job(choices=Choices(operation=Operation.DECODE, steps=steps), bundles=bundles, sources=())

    run(STEPS, small_bundle, bundle).check_steps()
    with pytest.raises(InvalidInputError, match=f"steps: got {STEPS + 1}"):
        run(STEPS + 1, bundle).check_steps()


def test_a_page_beside_other_references_is_refused(bundle: Path, small_device: list[str]) -> None:
    graph = Decoder.load(bundle, 1).graph
    assert isinstance(graph, EstimatorGraph)
    with Recording.open(small_device[3]) as recording:
        (page,), references = known_pages(recording, PROFILE, USED[:1]), recording.references()
    known = KnownPhases(page.pair, np.angle(page.symbols))
    mask = Bundle.open(bundle).pilot_mask
    check_counts(graph, known, mask, "page 0")
    table = {"reference_in_phase": references.in_phase, "reference_quadrature": references.quadrature}
    mirrored = {name: np.ascontiguousarray(frame[:, ::-1]) for name, frame in table.items()}
    with pytest.raises(CalibrationError, match="page 0"):
        check_counts(graph.with_table(mirrored), known, mask, "page 0")


def test_a_page_whose_pilots_are_not_the_devices_agrees_with_its_calibration(
    bundle: Path, small_device: list[str]
) -> None:
    graph = Decoder.load(bundle, 1).graph
    assert isinstance(graph, EstimatorGraph)
    mask = Bundle.open(bundle).pilot_mask
    others = Pilots(mask, 2 * np.pi * np.random.default_rng(0).random(np.count_nonzero(mask)))
    with Recording.open(small_device[3]) as recording:
        (page,) = known_pages(recording, PROFILE, USED[:1])
    known = KnownPhases(page.pair, np.angle(page.symbols))
    check_counts(graph.with_table(pilot_tensors(others)), known, mask, "page 0")


def test_an_error_that_repeats_at_each_symbol_becomes_a_flat_field(bundle: Path, small_device: list[str]) -> None:
    graph = Decoder.load(bundle, 1).graph
    assert isinstance(graph, EstimatorGraph)
    mask = Bundle.open(bundle).pilot_mask
    pattern = np.random.default_rng(0).normal(0, 0.05, PROFILE.page_shape)
    with Recording.open(small_device[3]) as recording:
        known = [KnownPhases(page.pair, np.angle(page.symbols)) for page in known_pages(recording, PROFILE, (0, 1, 2))]
    shifted = [KnownPhases(page.pair, page.phases - pattern) for page in known]
    usual, repeated = (measured_noise(graph, pages, mask, 1.0, STEPS) for pages in (known[:2], shifted[:2]))
    assert not usual[FLAT_FIELD].any()
    assert np.corrcoef(repeated[FLAT_FIELD].ravel(), pattern.ravel())[0, 1] > 0.9
    errors = []
    for table in ({}, repeated):
        (phase,) = graph.with_table(table).run(["phase"], shifted[2].feeds(mask))
        errors.append(wrapped(phase - shifted[2].phases)[~mask].std())
    assert errors[1] < 0.6 * errors[0]


def test_a_flat_field_takes_in_further_pages_that_are_read_better_with_it(
    bundle: Path, small_device: list[str], tmp_path: Path
) -> None:
    decoder = Decoder.load(bundle, 1)
    graph = decoder.graph
    assert isinstance(graph, EstimatorGraph)
    pattern = np.rint(np.random.default_rng(0).normal(0, 2, PROFILE.page_shape)).astype(np.int64)  # levels of 256
    mask = decoder.bundle.pilot_mask
    with Recording.open(small_device[3]) as usual:
        device = decoder.bundle.calibration.device(PROFILE, usual.references())
        assert flat_field_of(graph, usual, device, [0, 1], mask) == ({}, ())
        path = tmp_path / "R.h5"
        with RecordingWriter(path, PROFILE, 256, usual.bit_depth, usual.references()) as writer:
            for page in range(usual.pages):
                symbols = usual.symbols(page)
                assert symbols is not None
                writer.append((symbols.astype(np.int64) - pattern) % 256, usual.frames(page))
        again = tmp_path / "again.h5"
        with RecordingWriter(again, PROFILE, 256, usual.bit_depth, usual.references()) as writer:
            for _ in range(usual.pages):
                symbols = usual.symbols(0)
                assert symbols is not None
                writer.append((symbols.astype(np.int64) - pattern) % 256, usual.frames(0))
    with Recording.open(again) as repeated:  # what the model lacks for one page repeats on the same page
        assert flat_field_of(graph, repeated, device, [0, 1], mask) == ({}, ())
    with Recording.open(path) as repeating:
        grown = flat_field_of(graph, repeating, device, [0, 1], mask)
        two_pages = flat_field_of(graph, repeating, device, [*range(6)], mask)
    assert len(grown.hashes) == 2  # of six further pages, four stay unseen
    expected = 2 * np.pi * pattern / 256
    assert np.corrcoef(grown.table[FLAT_FIELD].ravel(), expected.ravel())[0, 1] > 0.95
    assert two_pages == ({}, ())  # the last two are kept to judge


def test_the_pages_of_a_calibration_are_enough_for_a_first_code(
    bundle: Path, small_device: list[str], tmp_path: Path
) -> None:
    two_pages = tmp_path / "R.h5"
    run(
        simulate, *small_device[:2], "--pages", len(USED), "--seed", 4, "--out", two_pages
    )  # the first of the recording
    told = run(code, "--bundle", bundle, "--recording", two_pages, "--out", tmp_path / "C.toml")
    first = load_code(tmp_path / "C.toml")
    decoder = Decoder.load(bundle, 1)
    assert f"{PageCodec(first, decoder.bundle.pilot_mask).user_bytes} user bytes a page" in told
    with Recording.open(small_device[3]) as recording:
        given = decoder, recording, tracker_for(decoder), "decode", []
        unseen = SeenPages.of(decoder, recording, unseen_pages(*given))
        calibrated = SeenPages.of(decoder, recording, unseen_pages(*given, in_sample=True))
        choice, _ = choose_code(decoder, recording, tracker_for(decoder))
    assert len(calibrated.errors) == len(USED)
    assert calibrated.drawn_by_concentrations().air_bits == pytest.approx(unseen.air_bits, abs=0.1)
    assert first.levels in (choice.code.levels // 2, choice.code.levels, choice.code.levels * 2)


@pytest.mark.parametrize("steps", [0, MOST_STEPS + 1])
def test_an_export_refuses_more_steps_than_are_measured(
    calibration: Calibration, small_device: list[str], tmp_path: Path, steps: int
) -> None:
    with Recording.open(small_device[3]) as recording, pytest.raises(InvalidInputError, match=f"steps: got {steps}"):
        export_calibration(calibration, recording, PROFILE, tmp_path / "B.zip", steps=steps)
    assert not list(tmp_path.iterdir())


def test_an_interrupted_export_leaves_nothing_and_the_next_one_works(
    calibration: Calibration, bundle: Path, small_device: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = Bundle.open(bundle)

    def interrupt(decoder: Decoder, *_: object) -> None:
        assert decoder.bundle.path.parent == tmp_path
        raise KeyboardInterrupt

    files = dict(made.files)
    with Recording.open(small_device[3]) as recording:
        monkeypatch.setattr(proof, "judged_manifest", interrupt)
        with pytest.raises(KeyboardInterrupt):
            proof.proven(tmp_path / "B.zip", made.manifest, files, recording.path, lambda what, share: None)
        assert not list(tmp_path.iterdir())
    monkeypatch.undo()
    assert proof.proven(tmp_path / "B.zip", made.manifest, files, None, lambda what, share: None)[1] == files


def test_steps_are_those_that_the_bundle_has(bundle: Path, small_bundle: Path) -> None:
    for path, steps in ((bundle, STEPS + 1), (bundle, 0), (small_bundle, 1)):
        with pytest.raises(InvalidInputError, match="steps"):
            Decoder.load(path, steps=steps)
    with pytest.raises(InvalidInputError, match="steps"):
        Decoder(Bundle.open(bundle), steps=0)


def page_of(settings: str, knock_px: float = 0.0) -> FramePair:
    """A page of the device with one number of its state changed, its image moved along x."""
    simulator = Simulator(PROFILE, Device().with_settings(["drift.shift_px=0", settings]), seed=3)
    simulator.knock((knock_px, 0.0))
    return simulator.page(random_symbols(PROFILE, 256, 1, np.random.default_rng([3, 0]))[0])


def test_frames_are_judged_by_chi_square(bundle: Path, small_device: list[str]) -> None:
    decoder = Decoder.load(bundle, 1)
    manifest, tracker = decoder.bundle.manifest, tracker_for(decoder)
    assert manifest.residual_output == "chi_square"
    assert manifest.residual_limit is not None
    with Recording.open(small_device[3]) as recording:
        good, other, references = recording.frames(2), recording.frames(3), recording.references()
    (early,) = decoder.graph.run(["chi_square"], {"in_phase": good.in_phase, "quadrature": good.quadrature}, 1)
    assert early < manifest.residual_limit / 2
    assert decoder.infer(good).residual == pytest.approx(1, abs=0.3)
    swapped, mixed = FramePair(good.quadrature, good.in_phase), FramePair(good.in_phase, other.quadrature)
    assert tracker.decode(good, 256).check.confirmed
    for wrong in (swapped, mixed, page_of("geometry.page_shift_x_px=2.5")):
        for decode in (decoder.decode, tracker.decode):
            with pytest.raises(FramesDisagreeError, match="chi-square"):
                decode(wrong, 256)
    with pytest.raises(FrameError, match="no light"):
        decoder.infer(references, doubtful=True)


def test_chi_square_is_judged_where_the_image_is_found(bundle: Path) -> None:
    decoder = Decoder.load(bundle, 1)
    knocked = page_of("homodyne.quadrature_gain=0.95", 6.0)
    with pytest.raises(FramesDisagreeError):
        decoder.decode(knocked, 256)
    tracker = tracker_for(decoder)
    tracker.decode(page_of("homodyne.quadrature_gain=0.95"), 256)
    for where in (tracker, tracker_for(decoder)):
        page = where.decode(knocked, 256)
        assert page.image is not None
        assert page.image.shift_x_px == pytest.approx(6, abs=0.05)
        assert page.check.confirmed


def test_a_walking_device_is_followed_without_loss(bundle: Path, tmp_path: Path) -> None:
    asked = ["--bundle", str(bundle), "--set", "drift.shift_px=0.3", "--pages", "6", "--compared", "2"]
    done = CliRunner().invoke(walking_device.main, [*asked, "--json", str(tmp_path / "F.json")])
    assert done.exit_code == 0, done.output
    figures = json.loads((tmp_path / "F.json").read_text())
    assert figures["lost"] == 0
    assert figures["farthest_px"] > 0.5
    assert figures["last_over_first"] > 0.95
    assert figures["position_error_px"] < 0.03


def test_a_page_tells_its_piston_and_its_brightness(bundle: Path) -> None:
    simulator = Simulator(PROFILE, Device().with_settings(["drift.shift_px=0", "drift.piston_rad=0.5"]), seed=3)
    symbols = random_symbols(PROFILE, 256, 2, np.random.default_rng([3, 0]))
    tracker = tracker_for(Decoder.load(bundle))
    shown = [simulator.simulate(page) for page in symbols]
    first, second = (tracker.decode(page.pair, 256) for page in shown)
    walked = math.remainder(shown[1].piston - shown[0].piston, 2 * math.pi)
    assert abs(walked) > 0.05
    assert math.remainder(second.piston_rad - first.piston_rad - walked, 2 * math.pi) == pytest.approx(0, abs=0.02)
    assert second.brightness == pytest.approx(1, abs=0.1)


def test_a_damaged_golden_page_is_noticed(bundle: Path, tmp_path: Path) -> None:
    opened, golden = Bundle.open(bundle), Bundle.open(bundle).golden
    files, damaged = dict(opened.files), golden.p + np.float32(0.01 * np.abs(golden.p).max())
    files[GOLDEN] = npz(in_phase=golden.pair.in_phase, quadrature=golden.pair.quadrature, p=damaged)
    write_bundle(tmp_path / "B.zip", opened.manifest, files)
    with pytest.raises(BundleError, match="golden"):
        Decoder.load(tmp_path / "B.zip", 1)


def test_its_pages_go_one_by_one_where_batches_are_wanted(bundle: Path, caplog: pytest.LogCaptureFixture) -> None:
    decoder = Decoder.load(bundle, 1, batching=Batching(largest=4))
    assert decoder.batches.largest == 1
    assert "calibration alone" in caplog.text


def test_the_graphs_calibrate_another_device_and_read_it(bundle: Path, tmp_path: Path) -> None:
    other = Device().with_settings([f"geometry.pipe_angle_deg={Device().geometry.pipe_angle_deg + 0.2}"])
    simulator = Simulator(PROFILE, other, seed=7)
    recording = tmp_path / "other.h5"
    with RecordingWriter(recording, PROFILE, 256, 8, simulator.references()) as writer:
        for symbols in random_symbols(PROFILE, 256, 5, np.random.default_rng(7)):
            writer.append(symbols, simulator.page(symbols))
    out, document = tmp_path / "other.zip", tmp_path / "other.toml"
    run(calibrate, "--graphs", bundle, "--recording", recording, "--out", document, "--export", out)
    found = load_calibration(document)
    assert found.goodness is not None
    assert found.goodness.verdict == "good"
    made = Bundle.open(out)
    assert made.files[DECODER] == Bundle.open(bundle).files[DECODER]
    assert made.manifest.calibrated_pages == found.calibrated_pages
    assert made.manifest.version != Bundle.open(bundle).version
    assert made.code is not None
    assert found.angle_deg(PROFILE) == pytest.approx(other.geometry.pipe_angle_deg, abs=0.02)
    assert air(Decoder.load(out), recording, range(2, 5)) > 6.2


def test_a_network_calibrates_no_other_device_and_a_gpu_needs_torch(
    small_bundle: Path, bundle: Path, small_device: list[str], tmp_path: Path
) -> None:
    common = ("--recording", small_device[3], "--out", tmp_path / "C.toml")
    with pytest.raises(BundleError, match="a network"):
        run(calibrate, *common, "--graphs", small_bundle)
    with pytest.raises(InvalidInputError, match="--graphs"):
        run(calibrate, *common, "--graphs", bundle, "--compute", "cuda")
    with pytest.raises(ProfileError, match="profile bench"):
        run(calibrate, *common, "--graphs", "bench")
    assert not list(tmp_path.iterdir())


def test_graphs_share_their_constants_with_the_one_for_other_servers(bundle: Path) -> None:
    files = Bundle.open(bundle).files
    assert sum(len(files[name]) for name in ESTIMATOR_FILES) < len(files[DECODER]) / 2
    alone = EstimatorFiles(*(files[name] for name in (OPERATORS, FIRST, EARLY, STEP)))
    with pytest.raises(BundleError, match="an ONNX model"):
        EstimatorGraph(alone, GraphFile(files[DECODER], "decoder"), "alone", 1)


def test_expected_counts_alone_are_those_of_the_whole_step(bundle: Path, small_device: list[str]) -> None:
    graph = Decoder.load(bundle, 1).graph
    assert isinstance(graph, EstimatorGraph)
    with Recording.open(small_device[3]) as recording:
        pair = recording.frames(2)
    page = graph.first_estimate({"in_phase": pair.in_phase, "quadrature": pair.quadrature})
    evaluated = page, {}, page["p"], page["nuisance"]
    alone = graph.derivatives(*evaluated, (EXPECTED,))[EXPECTED]
    np.testing.assert_allclose(alone, graph.derivatives(*evaluated)[EXPECTED], rtol=1e-5)


def test_a_page_that_few_steps_contradict_is_judged_by_all_of_them(bundle: Path, small_device: list[str]) -> None:
    opened = Bundle.open(bundle)
    with Recording.open(small_device[3]) as recording:
        pair = recording.frames(2)
    one, all_steps = (Decoder(opened, 1, steps=steps).infer(pair) for steps in (1, None))
    assert one.steps == 1
    assert all_steps.residual < one.residual
    limit = (one.residual + all_steps.residual) / 2

    def judged(limit: float) -> Inference:
        strict = replace(opened, manifest=opened.manifest.model_copy(update={"residual_limit": limit}))
        return Decoder(strict, 1, Decoder(opened, 1, steps=1).graph).infer(pair)

    assert judged(limit).steps == 1 + STEPS
    assert judged(limit).residual == all_steps.residual
    with pytest.raises(FramesDisagreeError):
        judged(all_steps.residual / 2)
