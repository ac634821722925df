"""The calibration document: read back as written, wrong documents refused by name."""

from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from lightpage.calibration.calibrate import KnownPage, Registered, calibrate, check_found
from lightpage.calibration.document import Calibration, load_calibration, parse_calibration
from lightpage.calibration.goodness.remedies import cause_of
from lightpage.calibration.goodness.verdict import Reading
from lightpage.calibration.known_pages import known_pages
from lightpage.calibration.parameters import NAMES, PRIORS
from lightpage.device.profile import load_profile
from lightpage.errors import CalibrationError, ProfileError, RecordingError
from lightpage.page.modulation import NOMINAL
from lightpage.page.modulation import PRIORS as PRIORS_OF_LEVELS
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.reader import Recording
from lightpage.recording.writer import RecordingWriter
from tests.lightpage.calibration.flat_twin import FlatTwin
from tests.lightpage.refused import refused
from tests.lightpage.small import UNEXPLAINED
from tests.lightpage.uneven import UNEVEN

PROFILE = load_profile("bench")
HASHES = ("0123456789abcdef" * 4, "f" * 64)


READ = Reading(
    in_sample=False,
    pages=4,
    air_bits=6.8,
    air_standard_error_bits=0.02,
    light_bits=6.9,
    user_bytes=3800,
    drift={"piston_rad": 0.15, "image_x_px": 0.01},
)


@pytest.fixture
def calibration() -> Calibration:
    rng = np.random.default_rng(1)
    registered = Registered(
        parameters=rng.normal(size=len(NAMES)) * PRIORS,
        deviations=PRIORS / 30,
        quadrature_phase=-1.55,
        coherence_before=0.01,
        coherence_after=0.8,
        cost=1.3,
        significant=0.7,
        modulation=UNEVEN,
        modulation_deviations=tuple(PRIORS_OF_LEVELS / 20),
        goodness=UNEXPLAINED,
    )
    return Calibration.from_registered(registered, PROFILE, HASHES)


def test_a_calibration_is_read_back_as_it_was_written(calibration: Calibration, tmp_path: Path) -> None:
    path = tmp_path / "calibration.toml"
    path.write_text("an older one")
    calibration.save(path)
    assert load_calibration(path) == calibration
    assert load_calibration(path).modulator == UNEVEN
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize(
    ("reading", "verdict", "lost"),
    [
        (READ, "good", 0.1),
        (READ.model_copy(update={"air_bits": 4.0}), "usable", 2.9),
        (READ.model_copy(update={"air_bits": 0.2, "user_bytes": 0}), "wrong", 6.7),
        (READ.model_copy(update={"in_sample": True}), "not judged", 1.2),
        (READ.model_copy(update={"in_sample": True, "air_bits": 0.2, "user_bytes": 0}), "wrong", 6.7),
        (READ.model_copy(update={"in_sample": True, "user_bytes": 0}), "not judged", 1.2),
        (None, "not judged", 1.2),
    ],
)
def test_the_verdict_is_what_was_read(
    calibration: Calibration, reading: Reading | None, verdict: str, lost: float
) -> None:
    judged = calibration.judged(reading)
    assert judged.goodness is not None
    assert (judged.goodness.verdict, judged.goodness.bits_lost) == (verdict, pytest.approx(lost))
    assert judged.is_wrong == (verdict == "wrong")
    assert verdict in judged.verdict_sentence
    assert parse_calibration(judged.to_toml()) == judged


def test_a_profile_with_other_lengths_is_not_good_however_much_is_read(calibration: Calibration) -> None:
    shorter = calibration.model_copy(update={"parameters": calibration.parameters | {"pipe_length_relative": -0.1}})
    judged = shorter.judged(READ)
    assert judged.goodness is not None
    assert judged.goodness.verdict == "usable"


def test_one_from_before_real_lenses_took_them_for_ideal(calibration: Calibration) -> None:
    lines = calibration.to_toml().splitlines()
    old = parse_calibration("\n".join(line for line in lines if not line.startswith("lens_path_relative")))
    assert (old.parameters["lens_path_relative"], old.deviations["lens_path_relative"]) == (-1, 0)


def test_one_from_before_modulators_were_fitted_took_their_levels_for_even(calibration: Calibration) -> None:
    old = parse_calibration(calibration.to_toml().partition("[modulation]")[0])
    assert old.modulator == NOMINAL
    assert old == parse_calibration(old.to_toml())


def test_the_angle_is_the_profiles_and_the_fitted_one(calibration: Calibration) -> None:
    tilted = PROFILE.model_copy(update={"pipe": PROFILE.pipe.model_copy(update={"angle_deg": 2.0})})
    fitted = np.rad2deg(calibration.parameters["pipe_angle_rad"])
    assert calibration.angle_deg(tilted) == pytest.approx(2.0 + fitted, abs=1e-12)


def test_a_calibration_of_another_profile_is_refused(calibration: Calibration) -> None:
    calibration.check_profile(PROFILE)
    with refused(got="bench", kind=ProfileError):
        calibration.check_profile(load_profile("paper"))


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("pipe_roll_rad", "pipe_rool_rad", "[parameters]"),
        ("turn_rad = -1.55", "turn_rad = nan", "turn_rad = nan"),
        ("coherence_after = 0.8", "coherence_after = 1.8", "coherence_after = 1.8"),
        ("schema_version = 1", "schema_version = 2", "schema_version = 2"),
        ("cost = ", "costs = ", "costs"),
        (HASHES[1], "../../etc/passwd", "calibrated_pages.1 = "),
        ("schema_version = 1", "schema_version = ", "TOML"),
        ("[deviations]", "[variances]", "variances"),
        ("stroke_relative = -0.1", "stroke = -0.1", "modulation"),
        ("stroke_relative = -0.1", "stroke_relative = inf", "stroke_relative"),
    ],
)
def test_a_wrong_document_is_refused_by_the_name_of_its_key(
    calibration: Calibration, old: str, new: str, named: str
) -> None:
    text = calibration.to_toml()
    assert old in text
    with pytest.raises(ProfileError) as caught:
        parse_calibration(text.replace(old, new, 1))
    assert named in str(caught.value)


def _record(path: Path, levels: int, symbols: np.ndarray | None) -> None:
    frame = np.full(PROFILE.frame_shape, 7, dtype=np.uint8)
    pair = FramePair(frame, frame)
    with RecordingWriter(path, PROFILE, levels, 8, pair) as writer:
        for index in range(2):
            writer.append(None if symbols is None else symbols[index], pair)


def test_known_pages_hold_the_phasors_at_the_recordings_level_count(tmp_path: Path) -> None:
    symbols = np.random.default_rng(0).integers(0, 8, (2, *PROFILE.page_shape), dtype=np.uint8)
    _record(tmp_path / "r.h5", 8, symbols)
    with Recording.open(tmp_path / "r.h5") as recording:
        (page,) = known_pages(recording, PROFILE, [1])
    np.testing.assert_allclose(page.symbols, np.exp(2j * np.pi * symbols[1] / 8), atol=1e-12)


def test_pages_without_symbols_are_not_known(tmp_path: Path) -> None:
    _record(tmp_path / "r.h5", 256, None)
    with Recording.open(tmp_path / "r.h5") as recording, refused("'symbols'", "none", RecordingError):
        known_pages(recording, PROFILE, [0])


BENCH_SYMBOLS = 56 * 87


@pytest.mark.parametrize(("coherence", "significant"), [(0.49, 0.51), (0.26, 0.25)])
def test_a_device_that_was_found_is_accepted(coherence: float, significant: float) -> None:
    check_found(coherence, significant, BENCH_SYMBOLS, {"x": 0.6, "y": 0.15})


@pytest.mark.parametrize(
    ("coherence", "significant"), [(0.0165, 0.5), (0.1, 0.5), (0.49, 0.03), (0.49, 0.099), (float("nan"), 0.5)]
)
def test_an_outcome_near_chance_is_no_calibration(coherence: float, significant: float) -> None:
    with refused("calibration, outcome", kind=CalibrationError):
        check_found(coherence, significant, BENCH_SYMBOLS, {"x": 0.6, "y": 0.3})


@pytest.mark.parametrize("branch", ["x", "y"])
def test_a_reflection_that_is_not_found_leaves_the_device_unknown(branch: str) -> None:
    reflected = {"x": 0.6, "y": 0.3} | {branch: 0.02}
    with refused(f"along {branch}", "2%", CalibrationError):
        check_found(0.43, 0.37, BENCH_SYMBOLS, reflected)


def test_a_page_too_small_to_be_found_is_refused_before_anything_is_searched() -> None:
    profile = PROFILE.model_copy(update={"page": PROFILE.page.model_copy(update={"columns": 20, "rows": 24})})
    frame = np.ones(profile.frame_shape, np.uint8)
    page = KnownPage(FramePair(frame, frame), np.ones(profile.page_shape, complex))
    solve = Mock(side_effect=AssertionError("nothing may be computed"))
    with refused("profile bench", "20 x 24", CalibrationError):
        calibrate(FlatTwin(profile), solve, profile, page.pair, [page])


def test_a_re_fit_remembers_where_the_device_began(calibration: Calibration) -> None:
    def later(coherence: float, page: str) -> Calibration:
        update = {"coherence_after": coherence, "calibrated_pages": (page * 64,), "turn_rad": -1.5}
        return calibration.model_copy(update=update)

    assert calibration.reference_coherence == 0.8
    assert "coherence_at_first" not in calibration.to_toml()
    second = calibration.followed_by(later(0.75, "1"))
    third = second.followed_by(later(0.7, "2"))
    assert parse_calibration(third.to_toml()) == third
    assert (third.coherence_after, third.reference_coherence, third.turn_rad) == (0.7, 0.8, -1.5)
    assert third.calibrated_pages == (*HASHES, "1" * 64, "2" * 64)


def test_a_re_fit_of_a_device_that_reads_is_not_called_wrong_by_the_light_that_it_leaves(
    calibration: Calibration,
) -> None:
    read = calibration.judged(READ)
    second = read.followed_by(calibration)
    third = second.followed_by(calibration)
    for refit in (second, third):
        assert refit.goodness is not None
        assert refit.goodness.verdict == "not judged"
        refit.check_good("re-fit")
    unread = calibration.followed_by(calibration)
    assert unread.is_wrong


def test_causes_are_read_back_as_they_were_written(calibration: Calibration) -> None:
    cause = cause_of("walls", 0.2, ' (+0.7 "um")')
    goodness = UNEXPLAINED.model_copy(update={"causes": (cause, cause_of("unknown", 0.1))})
    named = calibration.model_copy(update={"goodness": goodness})
    assert parse_calibration(named.to_toml()) == named


@pytest.mark.parametrize(("bits", "verdict"), [(0.2, "good"), (0.5, "usable")])
def test_causes_that_cost_much_make_no_good_fit(calibration: Calibration, bits: float, verdict: str) -> None:
    goodness = UNEXPLAINED.model_copy(update={"causes": (cause_of("crosstalk", bits), cause_of("unknown", 2.0))})
    judged = calibration.model_copy(update={"goodness": goodness}).judged(READ)
    assert judged.goodness is not None
    assert judged.goodness.verdict == verdict
