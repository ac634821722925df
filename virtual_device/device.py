"""A whole simulated device that looks like hardware: a page travels from the modulator through light to real packets.

Two cameras are on loopback, the pulse generator is on a serial port of its own, the modulator and the shutters are
behind a socket. `device.toml` in its folder says so to `camera:FOLDER/device.toml`.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from lightpage.device.profile import Profile
from lightpage.device.state import Device
from lightpage.errors import InvalidInputError
from lightpage.files import replace_text
from lightpage.runtime.device.cameras.pixel_formats import bit_depth
from lightpage.virtual_device.fake_camera import FakeCamera
from lightpage.virtual_device.light import Light
from lightpage.virtual_device.modulator import ModulatorSocket
from lightpage.virtual_device.namespace import ADDRESSES
from lightpage.virtual_device.pulse_generator import PulseGeneratorEmulator
from lightpage.virtual_device.serial_port import Pty

CONFIG = "device.toml"
SERIALS = ("LIGHTPAGE-I", "LIGHTPAGE-Q")
_PORT, _SOCKET, _PROFILE = "pulse-generator", "modulator.sock", "profile.toml"

Wire = Callable[[int], None]
"""Carries an edge to a camera, 0 or 1; tests put faults here."""


class VirtualDevice:
    """Runs until it is closed. Two of them need two private networks.

    Args:
        profile: nominal device.
        device: true state; its sensor's bit depth is that of `pixel_format`.
        folder: existing folder for port, socket and configuration.
        seed: seed of noise and drift.
        pixel_format: pixel format of both cameras.
        black_level: counts that both cameras add.

    Raises:
        InvalidInputError: a bit depth that the pixel format does not have.
        SourceError: no library of cameras, or their addresses cannot be listened on.
    """

    def __init__(
        self,
        profile: Profile,
        device: Device,
        folder: Path,
        seed: int = 0,
        pixel_format: str = "Mono8",
        black_level: int = 0,
    ) -> None:
        if bit_depth(pixel_format) != device.sensor.bit_depth:
            got = f"{device.sensor.bit_depth} bits in format {pixel_format}"
            raise InvalidInputError("simulated device", got, f"{bit_depth(pixel_format)} bits")
        self.profile, self.folder = profile, folder
        self.light = Light(profile, device, seed, black_level)
        self.wire: Wire = self._edge
        self._stack = ExitStack()
        try:
            self.cameras = tuple(
                self._stack.enter_context(FakeCamera(address, serial, self._picture(which), profile.frame_shape))
                for address, serial, which in zip(ADDRESSES, SERIALS, ("in_phase", "quadrature"), strict=True)
            )
            self.pulse_generator = PulseGeneratorEmulator({1: lambda: self.wire(0), 2: lambda: self.wire(1)})
            self.port = self._stack.enter_context(Pty(self.pulse_generator.answer, folder / _PORT))
            self.socket = self._stack.enter_context(ModulatorSocket(self.light, folder / _SOCKET))
            replace_text(folder / _PROFILE, profile.to_toml())
            replace_text(folder / CONFIG, _configuration(pixel_format))
        except BaseException:
            self._stack.close()
            raise

    @property
    def config(self) -> Path:
        """The configuration by which a service reads this device."""
        return self.folder / CONFIG

    def check(self) -> None:
        """Raise what went wrong with a camera's picture."""
        for camera in self.cameras:
            camera.check()

    def close(self) -> None:
        """Switch all of it off."""
        self._stack.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _edge(self, camera: int) -> None:
        self.cameras[camera].edge()

    def _picture(self, which: str) -> Callable[[], NDArray[np.unsignedinteger[Any]]]:
        return lambda: getattr(self.light.pair(), which)


def _configuration(pixel_format: str) -> str:
    cameras = "".join(
        f"""
[{role}]
driver = "aravis"
address = "{address}"
pixel_format = "{pixel_format}"
exposure_us = 200
trigger_source = "Line1"
packet_bytes = 9000
buffers = 16
"""
        for role, address in zip(("in_phase", "quadrature"), ADDRESSES, strict=True)
    )
    return f"""# A simulated device: cameras on loopback, pulse generator on a serial port of its own.
profile = "{_PROFILE}"
{cameras}
[trigger]
kind = "pulse_generator"
port = "{_PORT}"
channels = [1, 2]
fire = "software"

[modulator]
kind = "simulated"
address = "{_SOCKET}"

[beams]
kind = "simulated"
address = "{_SOCKET}"

# The machine that simulates a device is busy with it: its triggers come late now and then.
[pairing]
tolerance_s = 0.03
spacing_s = 0.08

# A page's light is simulated while it waits to be shown: a second for a small device, minutes for a large one.
[exposures]
repeats = 3
shot_s = 600
"""
