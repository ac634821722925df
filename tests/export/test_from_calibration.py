"""A bundle of a calibration alone reads its device's pages, with as many steps as it is asked for."""

from pathlib import Path

import numpy as np
import pytest

from lightpage.calibration.document import Calibration, load_calibration
from lightpage.calibration.known_pages import known_pages
from lightpage.calibration.likelihood.measure import measured_statistics
from lightpage.calibration.waves.wave_fit import WaveFit
from lightpage.device.state import Device
from lightpage.errors import CalibrationError, InvalidInputError
from lightpage.export import from_calibration
from lightpage.export.from_calibration import export_calibration
from lightpage.metrics.measures import measure
from lightpage.page.pilots import Pilots
from lightpage.page.symbols import random_symbols
from lightpage.recording.reader import Recording
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.bundle.manifest import DECODER, TWIN
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.runtime.model.execution.session import open_session
from lightpage.runtime.model.execution.twin import OnnxTwin
from lightpage.runtime.recalibration.known_pages import KnownPages
from lightpage.runtime.recalibration.recalibration import recalibrate
from lightpage.runtime.recalibration.refit import refit
from lightpage.simulator.simulator import Simulator
from lightpage.train.models.likelihood.estimator import PhaseEstimator
from lightpage.train.models.likelihood.torch_likelihood import TorchLikelihood
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
    statistics = measured_statistics(likelihood, twin, device, pages, conditions)
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


def test_one_graph_says_what_the_repeated_step_says(bundle: Path) -> None:
    decoder = Decoder.load(bundle)
    golden = decoder.bundle.golden
    whole = open_session(decoder.bundle.files[DECODER], DECODER, once=True)
    feeds = {"in_phase": golden.pair.in_phase, "quadrature": golden.pair.quadrature}
    (p,) = whole.run(["p"], feeds)
    repeated = decoder.infer(golden.pair).p
    assert np.linalg.norm(p - repeated) < 1e-3 * np.linalg.norm(p)


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


def test_steps_are_those_that_the_bundle_has(bundle: Path, small_bundle: Path) -> None:
    for path, steps in ((bundle, STEPS + 1), (bundle, 0), (small_bundle, 1)):
        with pytest.raises(InvalidInputError, match="steps"):
            Decoder.load(path, steps=steps)
