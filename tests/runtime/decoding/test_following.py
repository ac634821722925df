"""The Python call that the package advertises."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import runtime
from lightpage.device.profile import load_profile
from lightpage.device.state import Device
from lightpage.page.pilots import Pilots
from lightpage.page.symbols import random_symbols
from lightpage.simulator.simulator import Simulator
from runtime.decoding.decoder import Decoder
from runtime.decoding.tracking import NoTracker
from runtime.errors import UnconfirmedPageError
from tests.runtime import toy


@pytest.mark.parametrize("tracking", [True, False])
def test_a_page_that_its_pilots_contradict_is_an_error(tracking: bool, toy_zip: Path) -> None:
    decoder = runtime.load(toy_zip, threads=1, tracking=tracking)
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
    simulator.knock((2.5, -1.5))
    pair, decoder = simulator.page(symbols), runtime.load("bench", threads=1)
    data = ~decoder.bundle.pilot_mask
    assert (decoder.decode(pair).symbols != symbols)[data].mean() < 0.55
    with pytest.raises(UnconfirmedPageError):
        NoTracker(Decoder(decoder.bundle, 1, decoder.graph)).decode(pair, 256)
