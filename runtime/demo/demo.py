"""The main job on the simulated device: a service decodes, the device drifts, the service is recalibrated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.device.state import CameraPose, Device
from lightpage.errors import InvalidInputError
from lightpage.metrics.information import achievable_rate
from lightpage.progress import Progress
from lightpage.recording.reader import FramePair
from runtime.acquisition.simulator import SimulatorSource
from runtime.client.answers import Recalibrated
from runtime.client.client import LightpageClient
from runtime.decoding.decoder import Decoder
from runtime.decoding.image_tracker import tracker_for
from runtime.recalibration.refit import refit
from runtime.rpc.server import LightpageServer
from runtime.service.dataplane import DataPlane
from runtime.service.recalibrator import Recalibrator
from runtime.service.registry import ModelRegistry
from runtime.wire.pages import RemotePage

Floats = NDArray[np.float64]

LEVELS = 16
AIR_LEVELS = 256
"""Level count of the AIR: fine enough that it does not bound what a phase carries."""

PAGES_PER_SEED = 10_000
"""Another seed writes other pages, on the same device."""

RECALIBRATION_PAGES = 2


@dataclass(frozen=True)
class Phase:
    """What was decoded in one state of the device.

    Attributes:
        name: the state.
        model_version: the last page's.
        air: per data symbol, bits, mean over pages, [ny, nx]; not a number at pilots.
        confidence: mean over pages, [ny, nx].
        symbol_error_rate: of data symbols.
        seconds: of one decode in the service, median.
    """

    name: str
    model_version: str
    air: Floats
    confidence: Floats
    symbol_error_rate: float
    seconds: float

    @property
    def air_bits_per_symbol(self) -> float:
        """AIR over all data symbols."""
        return float(np.nanmean(self.air))

    def to_json(self) -> dict[str, Any]:
        """The figures under names that other programs read."""
        return {
            "name": self.name,
            "model_version": self.model_version,
            "air_bits_per_symbol": self.air_bits_per_symbol,
            "mean_confidence": float(self.confidence.mean()),
            "symbol_error_rate": self.symbol_error_rate,
            "seconds_per_page": self.seconds,
        }


@dataclass(frozen=True)
class DemoResult:
    """All of the demo: three phases, the recalibration between the last two, and one frame pair with what it says."""

    phases: tuple[Phase, ...]
    recalibrated: Recalibrated
    frames: FramePair
    symbols: NDArray[np.uint8]
    pages: int
    seed: int

    def to_json(self) -> dict[str, Any]:
        """The figures under names that other programs read."""
        recalibrated = self.recalibrated
        return {
            "seed": self.seed,
            "pages": self.pages,
            "levels": LEVELS,
            "air_levels": AIR_LEVELS,
            "phases": [phase.to_json() for phase in self.phases],
            "recalibration": {
                "model_version": recalibrated.model_version,
                "previous_version": recalibrated.previous_version,
                "pages_used": recalibrated.pages_used,
                "seconds": recalibrated.seconds,
                "angle_deg": recalibrated.angle_deg,
                "air_before": recalibrated.air_before,
                "air_after": recalibrated.air_after,
                "coherence_before": recalibrated.coherence_before,
                "coherence_after": recalibrated.coherence_after,
            },
        }


def drifted(device: Device) -> Device:
    """The device after a change of temperature: more than following the image's shift can make good."""

    def moved(pose: CameraPose) -> CameraPose:
        return pose.model_copy(
            update={
                "scale_relative_error": pose.scale_relative_error + 5e-4,
                "rotation_deg": pose.rotation_deg + 0.03,
            }
        )

    geometry = device.geometry.model_copy(
        update={
            "pipe_angle_deg": device.geometry.pipe_angle_deg + 0.03,
            "focal_length_relative_error": device.geometry.focal_length_relative_error + 3e-4,
        }
    )
    return device.model_copy(
        update={
            "geometry": geometry,
            "in_phase_camera": moved(device.in_phase_camera),
            "quadrature_camera": moved(device.quadrature_camera),
        }
    )


def run_demo(bundle: Path, pages: int, seed: int, progress: Progress = lambda what, share: None) -> DemoResult:
    """Decode, drift, decode, recalibrate, decode, all through a client of a service on this machine.

    Args:
        bundle: of the bench device.
        pages: pages decoded in each state, at least one.
        seed: of what is written.
        progress: told of every step, with the share of all that is done.

    Raises:
        LightpageError: an unusable bundle, or a recalibration that the service refuses.
    """
    if pages < 1:
        raise InvalidInputError("pages of the demo", pages, "at least 1")
    progress("load the bundle", 0.0)
    decoder = Decoder.load(bundle)
    device = Device()
    source = SimulatorSource(decoder.bundle.profile, device, LEVELS)
    plane = DataPlane(ModelRegistry(decoder, tracker_for), source)
    first = PAGES_PER_SEED * (1 + seed)
    known = first + 3 * pages
    frames = source.read(known + RECALIBRATION_PAGES).pair
    with (
        LightpageServer(plane, Recalibrator(plane, refit), "127.0.0.1:0") as server,
        LightpageClient(server.target) as client,
    ):

        def decode(name: str, state: int, start: float, end: float) -> Phase:
            found = []
            for number in range(pages):
                progress(name, start + (end - start) * number / pages)
                page = first + state * pages + number
                found.append(client.read_page(page, want_concentration=True, want_phase=True, want_written=True))
            return summarise(name, found)

        symbols = client.decode(frames, LEVELS).symbols
        fresh = decode("as calibrated", 0, 0.1, 0.3)
        source.set_device(drifted(device))
        lost = decode("after drift", 1, 0.3, 0.5)
        recalibrated = client.recalibrate(
            pages=range(known, known + RECALIBRATION_PAGES),
            progress=lambda step, share: progress(f"recalibrate: {step}", 0.5 + 0.3 * share),
        )
        again = decode("recalibrated", 2, 0.8, 1.0)
    progress("done", 1.0)
    return DemoResult((fresh, lost, again), recalibrated, frames, symbols, pages, seed)


def summarise(name: str, pages: Sequence[RemotePage]) -> Phase:
    """Figures and maps of decoded pages that come with what was written, phase and concentration."""
    rates, errors = [], []
    for page in pages:
        if page.phase is None or page.concentration is None or page.written is None or page.pilot_mask is None:
            raise InvalidInputError(f"page {page.page}", "symbols alone", "phase, concentration and what was written")
        fine = page.written.astype(np.int64) * (AIR_LEVELS // page.levels)
        rate = achievable_rate(page.phase, page.concentration, fine, AIR_LEVELS)
        rates.append(np.where(page.pilot_mask, np.nan, rate))
        errors.append((page.symbols != page.written)[~page.pilot_mask])
    return Phase(
        name=name,
        model_version=pages[-1].model_version,
        air=np.mean(rates, axis=0),
        confidence=np.mean([page.confidence for page in pages], axis=0, dtype=np.float64),
        symbol_error_rate=float(np.mean(errors)),
        seconds=float(np.median([page.timings.decode_s for page in pages])),
    )
