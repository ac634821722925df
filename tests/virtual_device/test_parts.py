"""The emulated pulse generator answers as the manual says; ports and private networks are there, or said not to be."""

import json
import os
import socket
from multiprocessing.connection import Client
from pathlib import Path

import numpy as np
import pytest

from lightpage.device.state import Device
from lightpage.errors import LightpageError, Reason, SourceError
from lightpage.page.symbols import random_symbols
from lightpage.runtime.device.modulator.simulated import SimulatedModulator
from lightpage.simulator.simulator import Simulator
from lightpage.virtual_device import namespace
from lightpage.virtual_device.light import Light
from lightpage.virtual_device.modulator import ModulatorSocket
from lightpage.virtual_device.pulse_generator import IDENTITY, PulseGeneratorEmulator
from lightpage.virtual_device.serial_port import TcpPort
from tests.lightpage.small import small_profile
from tests.runtime.device.acquisition.lab import reason_of


@pytest.mark.parametrize(
    ("message", "answer"),
    [
        ("*IDN?", IDENTITY),
        (":PULSe8:DELay?", "0.00000000000"),
        (":SPULSE:TRIGGER:MODE?", "DIS"),
        ("PULSE1:WIDT?", "?1"),
        (":", "?2"),
        (":PULSE9:STATE ON", "?3"),
        (":PULSE1:WIDT", "?4"),
        (":PULSE1:WIDT 1e4", "?5"),
        ("*IDN", "?6"),
        ("*TRG?", "?7"),
    ],
)
def test_grammar(message: str, answer: str) -> None:
    assert PulseGeneratorEmulator().answer(message) == answer


def test_an_address_that_cannot_be_had() -> None:
    with TcpPort(str.upper) as port, pytest.raises(LightpageError, match=r"^serial port"):
        TcpPort(str.upper, int(port.address.rpartition(":")[2])).plug()


def test_a_machine_that_cannot_have_one_and_a_shared_network_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, "if_nameindex", lambda: [(1, "lo"), (2, "eth0")])
    with pytest.raises(SystemExit, match="other interfaces"):
        namespace.main(["true"])
    monkeypatch.setenv("PATH", os.devnull)
    namespace.available.cache_clear()
    try:
        with pytest.raises(SourceError, match=r"^private network"):
            namespace.require()
    finally:
        namespace.available.cache_clear()


def test_pages_and_shutters_over_the_socket(tmp_path: Path) -> None:
    profile, device = small_profile(), Device().with_settings(["sensor.hot_pixel_share=1e-5"])
    light = Light(profile, device, seed=3, black_level=4)
    symbols = random_symbols(profile, 16, 1, np.random.default_rng(0))[0]
    driver = SimulatedModulator(tmp_path / "device.sock")
    with ModulatorSocket(light, tmp_path / "device.sock"):
        driver.show(symbols, 16, 5, 30.0)
        assert driver.shows()
        assert light.page_index == 5
        expected = Simulator(profile, device, 16, 3).page(symbols)
        seen = light.pair()
        assert (seen.in_phase == np.minimum(expected.in_phase.astype(int) + 4, 255)).all()
        driver.let_through(signal=False, reference=True)
        assert np.abs(light.pair().quadrature.astype(int) - seen.quadrature).max() > 20
        driver.let_through(signal=False, reference=False)
        assert set(np.unique(light.pair().in_phase)) == {4, 255}
        driver.let_through(signal=True, reference=True)
        assert (light.pair().in_phase == seen.in_phase).all()
        assert reason_of(lambda: driver.show(symbols[:-1], 16, 6, 30.0), driver.name) is Reason.NOT_ON_DISPLAY
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
    moved = reason_of(lambda: driver.let_through(signal=True, reference=False))
    assert moved is Reason.BEAM_CONTROL_FAILED  # it was there, and may come back


def test_messages_that_make_no_sense_are_answered_and_the_next_is_heeded(tmp_path: Path) -> None:
    light = Light(small_profile(), Device())
    wrong = (b"noise", b"{}", b'{"levels": 4, "shape": [2, 2], "page": 0}\nabc')
    with ModulatorSocket(light, tmp_path / "device.sock"), Client(str(tmp_path / "device.sock")) as connection:
        for sent in (*wrong, b'{"signal": false, "reference": false}'):
            connection.send_bytes(sent)
            assert set(json.loads(connection.recv_bytes())) == ({"error"} if sent in wrong else set())
    assert not light.pair().in_phase.any()
