"""A simulated bench device whose geometry changes with time as it is told, and which shows pages of user bytes."""

from __future__ import annotations

import io
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.parameters import NAMES, as_dict, indices
from lightpage.calibration.sampling_table import sampling_table
from lightpage.codec.volume import Volume, encode_volume
from lightpage.device.profile import Profile
from lightpage.device.state import Device
from lightpage.page.modulation import Modulation
from lightpage.page.pilots import Pilots
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.archives.recordings.coded_pages import air_bits
from lightpage.runtime.device.acquisition.source import SHOT_S, FrameSource, Shot
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.execution.twin import OnnxTwin
from lightpage.runtime.service.jobs.kept_pages import KeptPages
from lightpage.runtime.service.monitoring.observation import Observation
from lightpage.simulator.simulator import Simulator
from lightpage.simulator.true_optics import true_modulation, true_parameters

UNITS: Mapping[str, float] = {
    "geometry.pipe_angle_deg": 0.0037,
    "geometry.focal_length_relative_error": 6.2e-5,
    "geometry.pipe_length_relative_error": 5.2e-5,
    "geometry.pipe_width_relative_error": 2.5e-5,
    "geometry.page_shift_x_px": 0.038,
    "geometry.page_shift_y_px": 0.039,
    "geometry.pipe_roll_deg": 0.0034,
    "in_phase_camera.scale_relative_error": 1.2e-4,
    "in_phase_camera.rotation_deg": 0.0052,
    "in_phase_camera.shift_x_px": 0.22,
    "in_phase_camera.shift_y_px": 0.18,
    "quadrature_camera.scale_relative_error": 1.2e-4,
    "quadrature_camera.rotation_deg": 0.0052,
    "quadrature_camera.shift_x_px": 0.21,
    "quadrature_camera.shift_y_px": 0.16,
    "aberration.distortion_relative": 1.3e-4,
    "aberration.defocus_rad": 0.035,
    "aberration.astigmatism_rad": 0.035,
    "aberration.coma_rad": 0.035,
    "reference.tilt_x_rad": 0.038,
    "reference.tilt_y_rad": 0.04,
    "reference.curvature_rad": 0.05,
}
"""All geometry of a device without lens path, and how much of each alone costs a tracked bench page about 0.1 bit a
symbol; the shipped code's pages have 0.126 bit to spare."""

PAGES = 48
"""Different pages that are written, again and again."""

_REMEMBERED = 16
"""Pages whose truth is remembered."""


def direction(seed: int) -> NDArray[np.float64]:
    """A random direction of drift [units], of norm 1."""
    drawn = np.random.default_rng([seed, 1]).standard_normal(len(UNITS))
    return np.asarray(drawn / np.linalg.norm(drawn))


def moved(device: Device, units: NDArray[np.float64]) -> Device:
    """A device that has drifted by so many units [units] of each part of its geometry."""
    settings, data = [], device.model_dump()
    for (name, unit), by in zip(UNITS.items(), units, strict=True):
        table, key = name.split(".")
        settings.append(f"{name}={float(data[table][key]) + float(by) * unit!r}")
    return device.with_settings(settings)


def written_pages(decoder: Decoder, pages: int = PAGES, seed: int = 5) -> NDArray[np.uint8]:
    """Pages of random user bytes in the bundle's code, uint8 [pages, ny, nx].

    Raises:
        BundleError: the bundle has no code.
    """
    codec = decoder.page_codec
    content = io.BytesIO(np.random.default_rng(seed).bytes(codec.user_bytes * (pages - 1)))
    volume = Volume.of_file(content, 1 + seed, codec.user_bytes, pages - 1, 1)
    pilots = decoder.bundle.written_pilots(codec.code.levels)
    return np.concatenate(list(encode_volume(codec, volume, content, pilots)))


@dataclass(frozen=True)
class Truth:
    """Facts that the simulator knows of a page.

    Attributes:
        symbols: symbols that were written, uint8 [ny, nx].
        pair: frames of the page.
        device: true state.
        shift_px: walk of its image (x, y), on both cameras.
        optics: gives the reference frames of that moment.
    """

    symbols: NDArray[np.uint8]
    pair: FramePair
    device: Device
    shift_px: tuple[float, float]
    references: Callable[[], FramePair]


class DriftingSource(FrameSource):
    """A simulated bench device that drifts with a time that its user sets.

    Args:
        decoder: decoder of its bundle, whose code the pages are written in.
        state: the true device at a time, in pages.
        seed: seed of noise and walk.

    Attributes:
        moment: the time, in pages.
        shots: pages photographed until now.
    """

    name = "drifting bench device"

    def __init__(self, decoder: Decoder, state: Callable[[float], Device], seed: int = 0) -> None:
        self._pages, self._state = written_pages(decoder), state
        self.levels = decoder.page_codec.code.levels
        profile, device = decoder.bundle.profile, state(0.0)
        self.bit_depth, self.frame_shape, self.page_shape = (
            device.sensor.bit_depth,
            profile.frame_shape,
            profile.page_shape,
        )
        self._simulator = Simulator(profile, device, self.levels, seed)
        self._truths: OrderedDict[int, Truth] = OrderedDict()
        self._lock = threading.Lock()
        """Guards all that follows, and the simulator."""
        self.moment, self.shots, self._next = 0.0, 0, 0

    def knock(self, shift_px: tuple[float, float]) -> None:
        """Move the image at once."""
        with self._lock:
            self._simulator.knock(shift_px)

    def skip(self, shots: int) -> None:
        """Let shots pass unseen, as if they had been taken."""
        with self._lock:
            self._simulator.skip(shots)
            self.shots += shots

    def shot(self, timeout_s: float = SHOT_S, page: int | None = None) -> Shot:
        """Write page number `page`, or the next one, and photograph it."""
        with self._lock:
            if page is None:
                page, self._next = self._next, self._next + 1
            symbols = self._pages[page % len(self._pages)]
            self._settle()
            seen = self._simulator.simulate(symbols)
            self.shots += 1
            optics, simulator = self._simulator.device, self._simulator
            self._truths[page] = Truth(symbols, seen.pair, optics, seen.shift_px, simulator.references)
            while len(self._truths) > _REMEMBERED:
                self._truths.popitem(last=False)
            return Shot(seen.pair, page, symbols)

    def _settle(self) -> None:
        device = self._state(self.moment)
        if device != self._simulator.device:
            self._simulator.set_device(device)

    def references(self) -> FramePair:
        """Reference-only frames of the device as it is now."""
        with self._lock:
            self._settle()
            return self._simulator.references()

    def truth(self, page: int) -> Truth:
        """Return what the simulator knows of a page that was photographed lately."""
        with self._lock:
            return self._truths[page]


@dataclass(frozen=True)
class Untold:
    """Pages are kept without the symbols that the simulator knows."""

    kept: KeptPages

    def observe(self, observation: Observation) -> None:
        """See `Observer`."""
        self.kept.observe(replace(observation, symbols=None))


@dataclass(frozen=True)
class TrueTable:
    """Decoder with the bundle's network and the true device's table: the best that calibration could do.

    Attributes:
        decoder: decoder of the bundle.
    """

    decoder: Decoder

    @cached_property
    def _twin(self) -> OnnxTwin:
        return OnnxTwin(self.decoder.bundle)

    @cached_property
    def data(self) -> NDArray[np.bool_]:
        """Symbols that are no pilots, [ny, nx]."""
        return ~self.decoder.bundle.pilot_mask

    def air(self, truth: Truth, levels: int) -> float:
        """AIR of a page over 256 levels, bits per data symbol."""
        profile = self.decoder.bundle.profile
        parameters = true_parameters(profile, truth.device)
        for camera in ("in_phase", "quadrature"):
            for axis, shift in zip("xy", truth.shift_px, strict=True):
                parameters[NAMES.index(f"{camera}_shift_{axis}_px")] += shift
        references = truth.references()
        table = {
            "reference_in_phase": references.in_phase,
            "reference_quadrature": references.quadrature,
            **sampling_table(self._twin, parameters, truth.device.homodyne.turn_rad, profile),
        }
        bundle, modulation = self.decoder.bundle, true_modulation(truth.device.slm, self.decoder.bundle.profile)
        calibration = bundle.calibration.model_copy(update={"modulation": modulation.as_dict()}).to_toml()
        manifest = bundle.manifest.model_copy(update={"calibration": calibration})
        fed = Decoder(
            replace(bundle, manifest=manifest),
            self.decoder.threads,
            self.decoder.graph.with_table(self.decoder.taken(table)),
        )
        shown = modulation.page_levels(levels)
        page = fed.decode(truth.pair, levels, pilots=Pilots.of_symbols(bundle.pilot_mask, truth.symbols, shown))
        return air_bits(page, truth.symbols, self.data, shown)


def light_of(parameters: NDArray[np.float64], modulation: Modulation) -> dict[str, float]:
    """Return the stroke and the axial places of a device, by name."""
    names = [NAMES[index] for index in indices("axial")]
    return {"stroke_relative": modulation.coefficients[0], **{name: as_dict(parameters)[name] for name in names}}


def true_light(profile: Profile, device: Device) -> dict[str, float]:
    """Return `light_of` of a device's true parameters and modulation."""
    return light_of(true_parameters(profile, device), true_modulation(device.slm, profile))
