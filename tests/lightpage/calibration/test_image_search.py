"""A page's image is found by its pilots wherever it lies within reach, and nothing is found where it is not."""

import numpy as np
import pytest
from numpy.typing import NDArray

from lightpage.calibration.image_search import ImageSearch, needed_significance
from lightpage.calibration.sampling_table import registration_coefficients
from lightpage.device.state import Device
from lightpage.page.pilots import Pilots
from lightpage.page.symbols import random_symbols
from lightpage.recording.frame_pair import FramePair
from lightpage.simulator.simulator import Simulator
from lightpage.simulator.true_optics import true_parameters
from lightpage.train.models.field import FieldRecovery, TorchFieldSolver
from lightpage.train.models.twin import RayTwin, TorchTwin
from tests.lightpage.small import small_profile

PROFILE = small_profile()
DEVICE = Device().with_settings(["drift.shift_px=0.0"])
TWIN, PARAMETERS = TorchTwin(RayTwin(PROFILE)), true_parameters(PROFILE, DEVICE)
SEARCH = ImageSearch(TWIN, PARAMETERS, PROFILE)
SYMBOLS = random_symbols(PROFILE, 256, 1, np.random.default_rng(1))[0]

NEAR_PX = 0.3
"""A page decoded so near to its image reads a few bits and shows the rest of the way to the tracker."""


def known(symbols: NDArray[np.uint8] = SYMBOLS, count: int = 54) -> Pilots:
    """Return as many pilots as a bench page has, since the dozen of the small page are too few."""
    mask = np.zeros(PROFILE.page_shape, bool)
    mask.flat[np.random.default_rng(2).choice(mask.size, count, replace=False)] = True
    return Pilots.of_symbols(mask, symbols, 256)


@pytest.fixture(scope="module")
def fields() -> dict[tuple[float, float, bool], NDArray[np.complexfloating]]:
    """Fields of one page whose image lies (x, y) off, moving over a reference that stays or with it."""
    found = {}
    for x, y, stays in [(-2.6, 1.6, False), (8.0, -3.3, True), (-12.0, 12.0, False)]:
        simulator = Simulator(PROFILE, DEVICE, seed=4, reference_stays=stays)
        simulator.knock((x, y))
        found[x, y, stays] = field_of(simulator.page(SYMBOLS), simulator.references())
    return found


def field_of(pair: FramePair, references: FramePair) -> NDArray[np.complexfloating]:
    registration = registration_coefficients(TWIN, PARAMETERS, PROFILE)
    turn = DEVICE.homodyne.turn_rad
    homodyne = np.array([np.cos(turn), np.sin(turn)], np.float32)
    return TorchFieldSolver(FieldRecovery(PROFILE))(pair, references, registration, homodyne, {})[0]


def test_the_image_is_found_wherever_it_lies(
    fields: dict[tuple[float, float, bool], NDArray[np.complexfloating]],
) -> None:
    for (x, y, _), field in fields.items():
        found = SEARCH.find(field, known())
        assert found.found
        assert np.abs(found.shift_px - (x, y)).max() < NEAR_PX
        assert found.needed < 20 < found.significance


def test_beyond_reach_it_is_not_found_unless_it_is_looked_for_there(
    fields: dict[tuple[float, float, bool], NDArray[np.complexfloating]],
) -> None:
    field, away = fields[-12.0, 12.0, False], np.array([[9.0, -9.0]])
    assert not SEARCH.find(field, known(), away).found
    found = SEARCH.find(field, known(), np.vstack([away, [[-4.0, 4.0]]]))
    assert found.found
    assert np.abs(found.shift_px - (-12, 12)).max() < NEAR_PX


def test_other_pages_and_noise_are_not_found(
    fields: dict[tuple[float, float, bool], NDArray[np.complexfloating]],
) -> None:
    field = fields[-2.6, 1.6, False]
    rng = np.random.default_rng(3)
    for seed in range(4):
        others = random_symbols(PROFILE, 256, 1, np.random.default_rng(100 + seed))[0]
        mask = known().mask & ~Pilots.of_profile(PROFILE, 256).mask
        assert not SEARCH.find(field, Pilots.of_symbols(mask, others, 256)).found
        noise = rng.standard_normal(field.shape) + 1j * rng.standard_normal(field.shape)
        assert not SEARCH.find(noise, known()).found


@pytest.mark.parametrize("pilots", [4, 54, 200])
def test_what_is_needed_is_what_unrelated_light_reaches_as_seldom_as_stated(
    pilots: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """False alarms are counted at a higher rate: one in a hundred searches of an area that is one independent trial."""
    rng = np.random.default_rng(pilots)
    light = rng.standard_normal((5000, pilots)) + 1j * rng.standard_normal((5000, pilots))
    seen = np.abs(light.sum(axis=1)) ** 2 / np.sum(np.abs(light) ** 2, axis=1)
    stated = needed_significance(pilots)
    monkeypatch.setattr("lightpage.calibration.image_search.FALSE_ALARMS", 1e-2)
    assert np.mean(seen >= needed_significance(pilots, 2.0)) == pytest.approx(1e-2, rel=0.4)
    assert needed_significance(pilots, 2.0) < needed_significance(pilots, 200.0) < stated < pilots


@pytest.mark.parametrize("pilots", [1, 2, 3])
def test_pilots_that_agree_by_chance_wherever_they_are_looked_at_find_nothing(pilots: int) -> None:
    assert needed_significance(pilots) == np.inf
