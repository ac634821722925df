"""Bundles of decoders that nobody has trained, on simulated frames, written as `lightpage export` does."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from lightpage.calibration.calibrate import Registered
from lightpage.calibration.document import Calibration
from lightpage.calibration.parameters import NAMES
from lightpage.device.profile import Profile
from lightpage.device.state import Device
from lightpage.export.from_run import export_run
from lightpage.page.levels import MAX_LEVELS
from lightpage.page.symbols import pilot_mask, random_symbols
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import hash_frames
from lightpage.recording.reader import Recording
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.simulator.simulator import Simulator
from lightpage.simulator.true_optics import true_parameters
from lightpage.train.models.decoder import SymbolDecoder
from lightpage.train.models.hyperparameters import Hyperparameters
from lightpage.train.models.network import SymbolUNet
from lightpage.train.runs import GOLDEN, REFERENCES, Run, save_arrays, save_weights

_HEAD = 0.01
"""Deviation of the weights of networks' last layers, which begin with zeros: an answer of zeros would prove nothing."""


@dataclass(frozen=True)
class Seen:
    """Frames of both cameras of a device.

    Attributes:
        device: true state of the device.
        pair: a page, counts [H, W].
        references: the reference alone, counts [H, W].
    """

    device: Device
    pair: FramePair
    references: FramePair


def simulated(profile: Profile, device: Device, seed: int = 0) -> Seen:
    """Simulate a page of random symbols and the references; this takes minutes at full size.

    Args:
        profile, device: nominal device and its true state.
        seed: seed of symbols and noise.
    """
    simulator = Simulator(profile, device, seed=seed)
    symbols = random_symbols(profile, MAX_LEVELS, 1, np.random.default_rng(seed))[0]
    return Seen(device, simulator.page(symbols), simulator.references())


def recorded(path: Path, profile: Profile, device: Device) -> Seen:
    """The first page of a recording that `lightpage simulate` made of this device.

    Raises:
        RecordingError: no recording, or one of another profile.
    """
    with Recording.open(path) as recording:
        recording.header.check_against(profile)
        return Seen(device, recording.frames(0), recording.references())


def untrained_bundle(
    out: Path, profile: Profile, seen: Seen, localizer: str, choices: Hyperparameters, seed: int = 0
) -> Bundle:
    """Export a decoder with random weights and the true geometry.

    Args:
        out: new bundle, a zip where it ends in .zip.
        profile: the nominal device.
        seen: frames of a page, and the device that they are of.
        localizer, choices: arguments of `lightpage.train.models.decoder.SymbolDecoder`.
        seed: seed of the weights.

    Returns:
        The bundle as opened again.

    Raises:
        BundleError: something is at `out` already, or it does not say what torch says.
    """
    device = seen.device
    fitted = Registered(
        true_parameters(profile, device), np.ones(len(NAMES)), device.homodyne.turn_rad, 0.0, 1.0, 1.0, 1.0
    )
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        decoder = SymbolDecoder(profile, fitted.parameters, localizer, choices)
        for part in decoder.modules():
            for value in part.head.parameters() if isinstance(part, SymbolUNet) else ():
                torch.nn.init.normal_(value, std=_HEAD)
    with tempfile.TemporaryDirectory(prefix="lightpage-") as name:
        folder, pair, references = Path(name), seen.pair, seen.references
        save_weights(decoder.state_dict(), folder)
        save_arrays(folder / GOLDEN, {"in_phase": pair.in_phase, "quadrature": pair.quadrature})
        kept = {"in_phase": references.in_phase, "quadrature": references.quadrature, "pilots": pilot_mask(profile)}
        save_arrays(folder / REFERENCES, kept)
        Run(
            localizer=localizer,
            profile_toml=profile.to_toml(),
            calibration_toml=Calibration.from_registered(fitted, profile, [hash_frames(pair)]).to_toml(),
            hyperparameters=choices,
            camera_bit_depth=device.sensor.bit_depth,
            trained_pages=(),
            validation_air=0.0,
            kappa_scale=1.0,
            seconds=0.0,
        ).save(folder)
        return export_run(folder, out)[0]
