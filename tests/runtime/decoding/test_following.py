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


def test_an_image_that_has_moved_is_read_as_well_as_before_unless_it_is_not_followed() -> None:
    profile = load_profile("bench")
    simulator = Simulator(profile, Device(), seed=5)
    symbols = random_symbols(profile, 256, 2, np.random.default_rng(5))
    first = simulator.page(symbols[0])
    simulator.knock((2.5, -1.5))
    second = simulator.page(symbols[1])
    wrong = {}
    for tracking in (True, False):
        decoder = runtime.load("bench", tracking=tracking)
        data = ~decoder.bundle.pilot_mask
        assert ((decoder.decode(first).symbols != symbols[0])[data]).mean() < 0.55
        try:
            wrong[tracking] = float(((decoder.decode(second).symbols != symbols[1])[data]).mean())
        except UnconfirmedPageError:
            wrong[tracking] = 1.0
    assert wrong[True] < 0.55 < wrong[False]
