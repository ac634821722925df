"""Claims about registration on pages smaller than the shipped devices': how far it gets, and what it says then."""

import numpy as np
import pytest

from lightpage.calibration.calibrate import KnownPage, calibrate, check_agreement, refine
from lightpage.calibration.parameters import as_dict
from lightpage.device.profile import PageLayout, load_profile
from lightpage.device.state import Device, draw_device
from lightpage.errors import CalibrationError
from lightpage.page.symbols import symbol_phases
from lightpage.progress import Progress
from lightpage.simulator.simulator import Simulator
from lightpage.simulator.true_optics import true_parameters
from lightpage.study.known import Known
from lightpage.train.models.field import FieldRecovery, TorchFieldSolver
from lightpage.train.models.twin import RayTwin, TorchTwin
from tests.lightpage.refused import refused


def begin(progress: Progress, again: bool = False) -> None:
    """Calibrate on a page that hardly meets the walls, from nominal or again from what the device is."""
    bench = load_profile("bench")
    profile = bench.model_copy(
        update={
            "page": PageLayout(columns=30, rows=20, symbol_size_px=4),
            "camera": bench.camera.model_copy(update={"columns_px": 560, "rows_px": 400}),
        }
    )
    simulator = Simulator(profile, Device(), levels=16, seed=3)
    symbols = np.random.default_rng(0).integers(16, size=profile.page_shape).astype(np.uint8)
    page = KnownPage(simulator.page(symbols), np.exp(1j * symbol_phases(symbols, 16)))
    twin, solver = TorchTwin(RayTwin(profile)), TorchFieldSolver(FieldRecovery(profile))
    if again:
        start = true_parameters(profile, Device())
        refine(twin, solver, profile, simulator.references(), [page], start, -np.pi / 2, progress)
    else:
        calibrate(twin, solver, profile, simulator.references(), [page], progress)


def test_a_page_that_hardly_meets_the_walls_is_found_directly_and_then_named_as_too_narrow() -> None:
    told = list[tuple[str, float]]()
    with refused("'find the reflections'", kind=CalibrationError):
        begin(lambda *step: told.append(step))
    shares = [share for _, share in told]
    assert shares == sorted(shares)
    assert shares[-1] < 1
    assert [stage for stage, _ in told].count("find the direct image") > 3  # it may be stopped at any patch


def test_a_re_fit_tells_which_share_is_behind_when_its_first_stage_fails() -> None:
    shares = list[float]()
    with refused(kind=CalibrationError):
        begin(lambda stage, share: shares.append(share), again=True)
    assert shares == sorted(shares)
    assert 0 < shares[-1] < 0.5


def test_a_page_that_shows_nothing_of_what_the_others_show_is_named() -> None:
    check_agreement([0.5, 0.45])
    with refused("known page 1", kind=CalibrationError):
        check_agreement([0.5, 0.02, 0.49])


@pytest.mark.long
def test_cameras_far_apart_behind_an_astigmatic_launch_are_found_at_a_second_start() -> None:
    profile = load_profile("bench")
    simulator = Simulator(profile, draw_device(np.random.default_rng(1006)).of_profile(profile), levels=256, seed=3)
    symbols = np.random.default_rng(0).integers(256, size=profile.page_shape).astype(np.uint8)
    page = KnownPage(simulator.page(symbols), np.exp(1j * symbol_phases(symbols, 256)))
    shares = list[float]()
    twin, solver = TorchTwin(RayTwin(profile)), TorchFieldSolver(FieldRecovery(profile))
    found = calibrate(twin, solver, profile, simulator.references(), [page], lambda _, share: shares.append(share))
    assert found.goodness is not None
    assert found.goodness.verdict == "good"
    assert as_dict(found.parameters)["in_phase_axial_rad"] == pytest.approx(-1.4346, abs=0.01)
    assert shares == sorted(shares)


@pytest.mark.long
@pytest.mark.parametrize(
    "changed",
    [{"slm.falloff_relative": 0.4}, {"in_phase_camera.tilt_x_rad": 0.2, "quadrature_camera.tilt_x_rad": -0.2}],
)
def test_phases_of_a_small_page_that_were_a_turn_off_are_left_out(changed: dict[str, float]) -> None:
    profile = load_profile("analysis/comparison/eighth.toml")
    device = Device().of_profile(profile).with_values(changed)
    found = Known.of(profile, device, 4, 0).part(slice(2)).calibration(profile, lambda what, share: None)
    assert found.goodness is not None
    assert found.goodness.verdict == "good"
    apart = found.parameters["cameras_apart_x_rad"]
    assert apart == pytest.approx(changed.get("in_phase_camera.tilt_x_rad", 0.0), abs=0.01)
