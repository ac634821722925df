"""A device of a simulated fleet: what it has become, its recordings, and what bundles read of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

import h5py
import numpy as np

from analysis.comparison.data_set import LEVELS, simulate
from analysis.hardware.drifting import TrueTable, Truth, direction, moved
from lightpage.device.profile import Profile
from lightpage.device.state import Device
from lightpage.errors import LightpageError
from lightpage.page.pilots import Pilots
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.coded_pages import air_bits
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.simulator.simulator import Simulator

KNOWN, HELD_OUT = 3, 5
"""Pages of a device: known ones to recalibrate with, and others to measure on."""

UNITS = 2.0, 8.0
"""Least and most that a device has drifted, see `analysis.hardware.drifting.UNITS`."""

IMAGE_PX = 4.0
"""The most that its image has moved along an axis, camera pixels."""

POISONED, NOISE = "poisoned", "noise"
"""Names of the two devices whose known pages are spoilt."""


@dataclass(frozen=True)
class FleetDevice:
    """A device of the fleet.

    Attributes:
        name: name of the device.
        seed: seed of its drift, pages and noise.
        profile: the nominal device.
        before: state of the device as its bundle has it.
        folder: folder of its recordings.
        known: how many known pages it has.
    """

    name: str
    seed: int
    profile: Profile
    before: Device
    folder: Path
    known: int = KNOWN

    @property
    def state(self) -> Device:
        """State of the device today, after its drift."""
        rng = np.random.default_rng([self.seed, 2])
        drifted = moved(self.before, direction(self.seed) * rng.uniform(*UNITS))
        shifts = zip("xy", rng.uniform(-IMAGE_PX, IMAGE_PX, 2), strict=True)
        data = drifted.model_dump()
        settings = [
            f"{camera}.shift_{axis}_px={float(data[camera][f'shift_{axis}_px']) + float(by)!r}"
            for axis, by in shifts
            for camera in ("in_phase_camera", "quadrature_camera")
        ]
        return drifted.with_settings(settings)

    @property
    def recording(self) -> Path:
        """Recording of the device's known pages."""
        return self.folder / f"{self.name}.h5"

    @property
    def held_out(self) -> Path:
        """Recording of the device's other pages, with quantities that only a simulator knows."""
        return self.folder / f"{self.name}-held-out.h5"

    def make(self) -> None:
        """Simulate what is missing; a poisoned device and noise are spoilt before they get their names."""
        for path, pages, seed in (
            (self.recording, self.known, 2 * self.seed),
            (self.held_out, HELD_OUT, 2 * self.seed + 1),
        ):
            if path.exists():
                continue
            begun = path.with_name(f"{path.stem}-begun.h5")
            simulate(begun, self.profile, self.state, pages, seed, truth=path == self.held_out)
            with h5py.File(str(begun), "r+") as file:
                if self.name == POISONED:
                    file["symbols"][:] = np.roll(file["symbols"][()], 1, axis=0)
                elif self.name == NOISE:
                    rng = np.random.default_rng(self.seed)
                    for name in ("in_phase", "quadrature"):
                        file[name][:] = rng.integers(0, 128, file[name].shape, np.uint8)
            begun.rename(path)

    def air(self, old: Decoder, bundles: dict[str, str]) -> dict[str, Any]:
        """Mean AIR of its held-out pages by bundle, bits a symbol; `true` is the old network with the true table."""
        decoders = {"before": old} | {name: Decoder.load(path, old.threads) for name, path in bundles.items()}
        true = TrueTable(old)
        airs: dict[str, list[float]] = {"true": []}
        with Recording.open(self.held_out) as recording, h5py.File(str(self.held_out), "r") as file:
            shifts = file["truth/shift_px"][()]
            simulator = Simulator(self.profile, self.state, LEVELS, 2 * self.seed + 1)
            shown = [recording.shown(page) for page in range(recording.pages)]
            for (pair, symbols), (x, y) in zip(shown, shifts, strict=True):
                assert symbols is not None  # it has been simulated
                truth = Truth(symbols, pair, self.state, (float(x), float(y)), simulator.references)
                airs["true"].append(true.air(truth, LEVELS))
            for name, decoder in decoders.items():
                tracker, airs[name] = tracker_for(decoder), []
                for pair, symbols in shown:
                    assert symbols is not None
                    pilots = Pilots.of_symbols(decoder.bundle.pilot_mask, symbols, LEVELS)
                    try:
                        page = tracker.decode(pair, LEVELS, pilots)
                        airs[name].append(air_bits(page, symbols, ~decoder.bundle.pilot_mask, LEVELS))
                    except LightpageError:
                        airs[name].append(0.0)
        return {name: fmean(values) for name, values in airs.items()}
