"""Synthetic pages are like the recorded ones of the device that they are made after."""

from dataclasses import replace
from itertools import islice
from typing import NamedTuple

import numpy as np
import pytest

from lightpage.calibration.calibrate import KnownPage
from lightpage.calibration.parameters import NAMES
from lightpage.device.state import Device, SlmDefects
from lightpage.page.modulation import NOMINAL
from lightpage.page.symbols import random_symbols, symbol_phases
from lightpage.simulator.simulator import Simulator
from lightpage.simulator.true_optics import perfectly_calibrated
from lightpage.train.data.features import FeatureExtractor, PageFeatures
from lightpage.train.data.known_light import explained
from lightpage.train.data.synthetic import MOST_NOISE, PAGES_PER_STATE, ModelMatch, SyntheticPages, model_match
from lightpage.train.models.localizers.coherent import CoherentLocalizer
from tests.lightpage.small import small_profile

SEED = 5
FALLOFF = 0.25
PROFILE = small_profile()
DEVICE = Device(slm=SlmDefects(falloff_relative=FALLOFF))


class Recorded(NamedTuple):
    features: PageFeatures
    extractor: FeatureExtractor
    page: KnownPage


@pytest.fixture(scope="module")
def recorded() -> Recorded:
    """Simulate a recorded page, with its features."""
    simulator = Simulator(PROFILE, DEVICE, seed=SEED)
    phases = symbol_phases(random_symbols(PROFILE, 256, 1, np.random.default_rng(SEED))[0], 256)
    pair = simulator.page(np.rint(phases / (2 * np.pi) * 256).astype(np.uint8))
    extractor = FeatureExtractor(perfectly_calibrated(PROFILE, DEVICE, simulator.references()))
    features, _ = extractor.page(extractor.field(pair), phases, np.zeros(2))
    return Recorded(features, extractor, KnownPage(pair, np.exp(1j * phases)))


@pytest.fixture(scope="module")
def like(recorded: Recorded) -> ModelMatch:
    return model_match(explained(recorded.extractor, [recorded.page]))


def agreement(page: PageFeatures) -> float:
    """Coherence of the direct branch with what was written, over the page."""
    light = page.light.astype(np.float64)[:, 0].mean(1)
    z = (light[0] + 1j * light[1]) * np.exp(-1j * page.phases)
    return float(abs(z.mean()) / np.sqrt(np.mean(np.abs(z) ** 2)))


def test_the_fitted_waves_explain_the_recorded_light_and_its_fall_off(like: ModelMatch) -> None:
    assert like.noise < 0.05
    constant, _, _, x2, _, y2 = like.illumination
    assert constant == pytest.approx(1)
    # the simulator's fall-off is quadratic in the radius, and reaches its full at the corner (1, 1)
    assert -(x2 + y2).real == pytest.approx(FALLOFF, abs=0.03)


def test_the_light_of_an_uneven_modulator_is_explained_and_made_and_its_phases_are_the_targets() -> None:
    slm = SlmDefects(stroke_relative_error=-0.1, level_sine_rad=0.3, unmodulated_relative=0.1)
    simulator = Simulator(PROFILE, device := Device(slm=slm), seed=SEED)
    symbols = random_symbols(PROFILE, 256, 1, np.random.default_rng(SEED))[0]
    known = KnownPage(simulator.page(symbols), np.exp(1j * symbol_phases(symbols, 256)))
    told = perfectly_calibrated(PROFILE, device, simulator.references())
    extractor, ignorant = FeatureExtractor(told), FeatureExtractor(replace(told, modulation=NOMINAL))
    like = model_match(explained(extractor, [known]))
    assert like.noise < 0.02
    assert 2 * like.noise < model_match(explained(ignorant, [known])).noise
    levels = told.modulation.page_levels(256)
    page = next(SyntheticPages(told, like, CoherentLocalizer(PROFILE), SEED).pages())
    assert set(np.unique(page.phases)) <= set(levels.phases.astype(np.float32))
    even = replace(page, phases=symbol_phases(levels.nearest(page.phases), 256))
    assert agreement(page) > agreement(even) + 0.01


def test_other_symbols_explain_nothing_and_another_angle_less(like: ModelMatch, recorded: Recorded) -> None:
    others = replace(recorded.page, symbols=recorded.page.symbols[::-1])
    assert model_match(explained(recorded.extractor, [others])).noise > MOST_NOISE
    device = recorded.extractor.device
    other = device.parameters.copy()
    other[NAMES.index("pipe_angle_rad")] += np.deg2rad(0.5)
    turned = FeatureExtractor(replace(device, parameters=other))
    assert model_match(explained(turned, [recorded.page])).noise > 3 * like.noise


def test_synthetic_light_shows_its_symbols_as_the_recorded_light_does(like: ModelMatch, recorded: Recorded) -> None:
    pages = list(islice(SyntheticPages(recorded.extractor.device, like, CoherentLocalizer(PROFILE), SEED).pages(), 4))
    found = np.array([agreement(page) for page in pages])
    # pages of this size differ by their symbols' chance neighbours
    assert found.mean() == pytest.approx(agreement(recorded.features), rel=0.06)
    assert pages[0].light.shape == recorded.features.light.shape


def test_pages_are_the_same_from_wherever_one_starts_and_states_differ(like: ModelMatch, recorded: Recorded) -> None:
    made = SyntheticPages(recorded.extractor.device, like, CoherentLocalizer(PROFILE), SEED)
    count = PAGES_PER_STATE + 2
    all_pages = list(islice(made.pages(), count))
    again = next(islice(made.pages(PAGES_PER_STATE + 1), 1))
    np.testing.assert_array_equal(again.light, all_pages[-1].light)
    np.testing.assert_array_equal(again.phases, all_pages[-1].phases)
    np.testing.assert_array_equal(all_pages[0].positions, all_pages[1].positions)
    assert np.abs(all_pages[0].positions - all_pages[-1].positions).max() > 1e-5
