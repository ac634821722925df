"""A simulated device shows pages and moves its shutters as its driver says."""

from __future__ import annotations

import json
from multiprocessing.connection import Client
from pathlib import Path

import numpy as np
import pytest

from lightpage.device.state import Device
from lightpage.page.symbols import random_symbols
from lightpage.simulator.simulator import Simulator
from runtime.errors import LostShotError, Reason, SourceError
from runtime.modulator.simulated import SimulatedModulator
from runtime.virtual_device.light import Light
from runtime.virtual_device.modulator import ModulatorSocket
from tests.lightpage.small import small_profile


def test_pages_and_shutters_over_the_socket(tmp_path: Path) -> None:
    profile, device = small_profile(), Device()
    hot = np.array([[1, 2], [3, 4]])
    light = Light(profile, device, seed=3, black_level=4, hot=hot)
    symbols = random_symbols(profile, 16, 1, np.random.default_rng(0))[0]
    driver = SimulatedModulator(tmp_path / "device.sock")
    with ModulatorSocket(light, tmp_path / "device.sock"):
        driver.show(symbols, 16, 5, 30.0)
        assert driver.shows()
        assert light.page_index == 5
        expected = Simulator(profile, device, 16, 3).page(symbols)
        seen = light.pair()
        assert (seen.in_phase[tuple(hot.T)] == 255).all()
        free = np.ones(seen.in_phase.shape, bool)
        free[tuple(hot.T)] = False
        lifted = np.minimum(expected.in_phase[free].astype(int) + 4, 255)
        assert (seen.in_phase[free] == lifted).all()
        driver.let_through(signal=False, reference=True)
        assert np.abs(light.pair().quadrature[free].astype(int) - seen.quadrature[free]).max() > 20
        driver.let_through(signal=False, reference=False)
        assert set(np.unique(light.pair().in_phase)) == {4, 255}
        driver.let_through(signal=True, reference=True)
        assert (light.pair().in_phase == seen.in_phase).all()
        with pytest.raises(LostShotError, match=r"^simulated modulator") as raised:
            driver.show(symbols[:-1], 16, 6, 30.0)
        assert raised.value.reason is Reason.NOT_ON_DISPLAY
        driver.show(symbols, 16, 7, 30.0)
    driver.close()


def test_a_device_that_is_not_there_is_named(tmp_path: Path) -> None:
    driver = SimulatedModulator(tmp_path / "nowhere.sock")
    assert not driver.shows()
    with pytest.raises(SourceError, match=r"nowhere\.sock"):
        driver.open(1.0)
    with ModulatorSocket(Light(small_profile(), Device()), tmp_path / "nowhere.sock"):
        driver.open(1.0)
    driver.close()
    with pytest.raises(LostShotError) as raised:  # it was there, and may come back
        driver.let_through(signal=True, reference=False)
    assert raised.value.reason is Reason.BEAM_CONTROL_FAILED


def test_messages_that_make_no_sense_are_answered_and_the_next_is_heeded(tmp_path: Path) -> None:
    light = Light(small_profile(), Device())
    wrong = (b"noise", b"{}", b'{"levels": 4, "shape": [2, 2], "page": 0}\nabc')
    with ModulatorSocket(light, tmp_path / "device.sock"), Client(str(tmp_path / "device.sock")) as connection:
        for sent in (*wrong, b'{"signal": false, "reference": false}'):
            connection.send_bytes(sent)
            assert set(json.loads(connection.recv_bytes())) == ({"error"} if sent in wrong else set())
    assert not light.pair().in_phase.any()
