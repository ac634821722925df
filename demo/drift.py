"""The simulated device of the demo, and how it drifts."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lightpage.demo.result import DriftStep
from lightpage.device.profile import Profile
from lightpage.device.state import CameraPose, Device, draw_rough
from lightpage.errors import InvalidInputError, LostPageError
from lightpage.runtime.client.client import LightpageClient
from lightpage.runtime.device.acquisition.simulator import SimulatorSource
from lightpage.runtime.device.acquisition.source import FrameSource, open_source
from lightpage.runtime.device.modulator.simulated import SimulatedModulator

OTHER_DEVICE = 5
"""Seed of the device that the demo calibrates; its cameras see nearly the same plane."""
DRIFT_STEPS = (0.04, 0.08, 0.15, 0.3)
"""Shares of the change of temperature of `drifted`: the code's margin lasts for the first, and nobody recalibrates."""


def drifted(device: Device, share: float = 1.0) -> Device:
    """The device after a change of temperature: more than following the image's shift can make good."""

    def moved(pose: CameraPose) -> CameraPose:
        return pose.model_copy(
            update={
                "scale_relative_error": pose.scale_relative_error + 5e-4 * share,
                "rotation_deg": pose.rotation_deg + 0.03 * share,
            }
        )

    geometry = device.geometry.model_copy(
        update={
            "pipe_angle_deg": device.geometry.pipe_angle_deg + 0.03 * share,
            "focal_length_relative_error": device.geometry.focal_length_relative_error + 3e-4 * share,
        }
    )
    return device.model_copy(
        update={
            "geometry": geometry,
            "in_phase_camera": moved(device.in_phase_camera),
            "quadrature_camera": moved(device.quadrature_camera),
        }
    )


def other_device() -> Device:
    """A device that nobody has calibrated: its numbers scatter as those of devices on a bench do."""
    device = draw_rough(np.random.default_rng(OTHER_DEVICE))
    return device.model_copy(update={"sensor": Device().sensor})


def simulated_device(
    spec: str | None, profile: Profile, *, known: bool
) -> tuple[FrameSource, Callable[[Device], None], Device]:
    """A simulated device, what lets it drift, and its true state.

    Args:
        spec: ``camera:DEVICE.toml`` of a simulated device that runs as hardware; None for one in this process.
        profile: nominal.
        known: whether it is the simulator's default device, to which the shipped bundle belongs.

    Raises:
        InvalidInputError: a source that is no simulated device.
    """
    if spec is None:
        device = Device() if known else other_device()
        simulator = SimulatorSource(profile, device)
        return simulator, simulator.set_device, device
    source = open_source(spec)
    modulator = source.modulator
    if not isinstance(modulator, SimulatedModulator):
        source.close()
        raise InvalidInputError(f"source {spec}", "no simulated device", "one of `lightpage virtual-device`")
    return source, modulator.drift, Device()


def drift_in_steps(
    client: LightpageClient, drift: Callable[[Device], None], device: Device, told: Callable[[], None]
) -> tuple[DriftStep, ...]:
    """Let the device drift in steps, and read one page after each."""
    steps: list[DriftStep] = []
    for share in DRIFT_STEPS:
        told()
        drift(drifted(device, share))
        try:
            page = client.pages.read(0, user_data=True)
        except LostPageError as error:
            steps.append(DriftStep(share, None, error.recalibration_due, True))
            continue
        found = page.user_data
        assert found is not None  # it was asked for
        steps.append(DriftStep(share, found.margin_bits, page.recalibration_due, found.data is None))
    return tuple(steps)
