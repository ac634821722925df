"""The Python call that the package advertises, and the shipped bundle: its name, and that it follows its device."""

from pathlib import Path

import numpy as np
import pytest

import lightpage
from lightpage.device.profile import load_profile
from lightpage.device.state import Device
from lightpage.errors import BundleError, FramesDisagreeError, UnconfirmedPageError
from lightpage.metrics.measures import measure
from lightpage.page.pilots import Pilots
from lightpage.page.symbols import random_symbols
from lightpage.runtime.model.bundle.shipped import DEFAULT, bundle_path
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_drift import SHIFT, TILT, BundleTables
from lightpage.runtime.model.decoding.image_tracker import RETRACE_RAD, ImageTracker, tracker_for
from lightpage.runtime.model.decoding.tracking import NoTracker
from lightpage.runtime.model.execution.twin import OnnxTwin
from lightpage.simulator.simulator import Simulator
from tests.runtime import toy


@pytest.mark.parametrize("tracking", [True, False])
def test_a_page_that_its_pilots_contradict_is_an_error(tracking: bool, toy_zip: Path) -> None:
    decoder = lightpage.load(toy_zip, threads=1, tracking=tracking)
    symbols = toy.symbols_of(16, 1)[0]
    page = decoder.decode(toy.ToyDevice().page(symbols, 16), 16)
    assert (page.symbols == symbols).mean() > 0.99
    other = np.random.default_rng(3).permutation(decoder.pilots(16).phases)
    with pytest.raises(UnconfirmedPageError):
        decoder.decode(toy.ToyDevice().page(symbols, 16), 16, pilots=Pilots(decoder.bundle.pilot_mask, other))


def test_an_image_that_has_moved_is_read_unless_it_is_not_followed() -> None:
    profile = load_profile("bench")
    simulator = Simulator(profile, Device(), seed=5)
    symbols = random_symbols(profile, 256, 1, np.random.default_rng(5))[0]
    simulator.knock((7.5, -4.5))
    pair, decoder = simulator.page(symbols), lightpage.load("bench", threads=1)
    data = ~decoder.bundle.pilot_mask
    assert (decoder.decode(pair).symbols != symbols)[data].mean() < 0.55
    with pytest.raises(FramesDisagreeError):
        NoTracker(Decoder(decoder.bundle, 1, decoder.graph)).decode(pair, 256)


def test_a_name_is_the_shipped_bundle_even_beside_a_folder_of_that_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / DEFAULT).mkdir()
    monkeypatch.chdir(tmp_path)
    assert bundle_path(DEFAULT).name == f"{DEFAULT}.zip"
    assert bundle_path(DEFAULT).is_file()
    assert bundle_path(f"./{DEFAULT}") == Path(f"./{DEFAULT}")
    with pytest.raises(BundleError):
        bundle_path("nothing-of-that-name")


@pytest.mark.long  # traces full pages of the shipped bundle; the tracker by itself is tested on small ones
def test_the_shipped_decoder_follows_an_image_that_moves_over_its_reference() -> None:
    """Which tilts it; so far off, the table is traced again, and holds the tilt from then on."""
    decoder = Decoder.load(bundle_path(DEFAULT))
    profile, levels, by = decoder.bundle.profile, 256, np.array([9.0, -6.0])
    simulator = Simulator(profile, Device().with_settings(["drift.shift_px=0.0"]), levels, 8, reference_stays=True)
    written = np.asarray(random_symbols(profile, levels, 1, np.random.default_rng(8))[0])
    tracker = tracker_for(decoder)
    assert isinstance(tracker, ImageTracker)
    rates = []
    for _ in range(3):
        page = tracker.decode(simulator.page(written), levels)
        rates.append(measure(page.phase, page.concentration, written, levels).air_bits_per_symbol)
        if len(rates) == 1:
            simulator.knock((float(by[0]), float(by[1])))
    state = tracker.state
    expected = BundleTables(decoder, OnnxTwin(decoder.bundle)).tilt_of(by)
    np.testing.assert_allclose(state.drift[SHIFT], by, atol=0.03)
    # the reference's ripple, of which other parts lie under the image now, adds a tilt of its own
    assert np.linalg.norm(state.drift[TILT] - expected) < 0.5 * np.linalg.norm(expected)
    assert np.abs(state.untraced[TILT]).max() < RETRACE_RAD
    assert state.decoder is not decoder
    assert rates[2] > 0.97 * rates[0]
