"""What is asked of a GigE camera beside its driver, and of the kernel."""

from __future__ import annotations

import socket
import time

import pytest

from runtime.cameras import gige_network
from runtime.cameras.gige_network import CONTROL_PRIVILEGE, read_register, receive_buffer_problem, route_mtu
from runtime.errors import SourceError
from tests.runtime.cameras.scene import ADDRESS, SENSOR, SERIAL, noise, scene


@pytest.mark.own_network
def test_a_camera_says_whether_it_is_controlled() -> None:
    with scene() as stage:
        assert read_register(ADDRESS, CONTROL_PRIVILEGE) == 0
        stage.camera.arm()
        assert read_register(ADDRESS, CONTROL_PRIVILEGE)
        stage.camera.close()
        assert read_register(ADDRESS, CONTROL_PRIVILEGE) == 0
        assert stage.fake.serial == SERIAL
        assert noise("Mono8", 0).shape == SENSOR


@pytest.mark.own_network
def test_silence_takes_no_longer_than_it_may() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as dumb:
        dumb.bind((ADDRESS, gige_network.PORT))
        started = time.monotonic()
        assert read_register(ADDRESS, CONTROL_PRIVILEGE, timeout_s=0.05, tries=2) is None
        assert 0.09 < time.monotonic() - started < 2
    assert read_register(ADDRESS, CONTROL_PRIVILEGE) is None


@pytest.mark.own_network
def test_packets_as_large_as_the_way_takes() -> None:
    assert route_mtu(ADDRESS) == gige_network.LARGEST_PACKET


def test_a_name_that_nobody_knows_is_an_error() -> None:
    with pytest.raises(SourceError, match=r"no\.host\.invalid"):
        read_register("no.host.invalid", CONTROL_PRIVILEGE)


def test_a_receive_buffer_that_is_too_small_names_the_setting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gige_network, "_may_read_packets", lambda: False)
    assert receive_buffer_problem(2048) == ""
    assert "net.core.rmem_max=1000000000" in receive_buffer_problem(1_000_000_000)
    monkeypatch.setattr(gige_network, "_may_read_packets", lambda: True)
    assert receive_buffer_problem(1_000_000_000) == ""
