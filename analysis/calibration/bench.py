"""A calibration from nominal on a drawn device, and what it came to beside the truth."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from analysis.foreign_device import ForeignDevice
from lightpage.calibration.calibrate import KnownPage, Registered, calibrate
from lightpage.calibration.coherence import page_coherence
from lightpage.calibration.known_pages import known_pages
from lightpage.calibration.parameters import NAMES, as_dict, as_vector
from lightpage.calibration.samplers import FieldSampler
from lightpage.calibration.sampling_table import needed_apart, registration_coefficients
from lightpage.device.profile import Profile
from lightpage.device.state import Device
from lightpage.errors import CalibrationError
from lightpage.page.symbols import random_symbols, symbol_phases
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.reader import Recording
from lightpage.simulator.simulator import Simulator
from lightpage.simulator.true_optics import true_parameters
from lightpage.train.models.field import FieldRecovery, TorchFieldSolver
from lightpage.train.models.twin import RayTwin, TorchTwin
from lightpage.waves.grid import field_grid

LEVELS = 256


@dataclass(frozen=True)
class Outcome:
    """Outcome of one device. Angles in degrees; None where a figure could not be measured."""

    seed: int
    angle_deg: float
    angle_error_deg: float | None = None
    turn_error_deg: float | None = None
    relation_error_px: float | None = None
    coherence: float | None = None
    oracle_coherence: float | None = None
    ratio: float | None = None
    seconds: float | None = None
    verdict: str | None = None
    bits_lost: float | None = None
    parameters: dict[str, float] | None = None
    failure: str | None = None

    def line(self) -> str:
        def show(value: float | None, form: str) -> str:
            return format(value, form) if value is not None else format("-", form.partition(".")[0].lstrip("+"))

        text = (
            f"{self.seed:>6} {self.angle_deg:>+9.4f} {show(self.angle_error_deg, '>9.4f')} "
            f"{show(self.turn_error_deg, '>9.2f')} {show(self.relation_error_px, '>8.2f')} "
            f"{show(self.coherence, '>9.4f')} {show(self.oracle_coherence, '>9.4f')} "
            f"{show(self.ratio, '>7.3f')} {show(self.seconds, '>7.1f')} {self.verdict or '-':>8} "
            f"{show(self.bits_lost, '>6.3f')}"
        )
        return f"{text}  {self.failure}" if self.failure else text


HEADER = (
    f"{'seed':>6} {'angle':>9} {'error':>9} {'Q phase':>9} {'relation':>8} "
    f"{'coherence':>9} {'oracle':>9} {'ratio':>7} {'seconds':>7} {'verdict':>8} {'lost':>6}"
)


class Bench:
    """The nominal device with its twin and field solver, which every device shares."""

    def __init__(self, profile: Profile, pages: int, draw: Callable[[np.random.Generator], Device]) -> None:
        self.profile, self.pages, self._draw = profile, pages, draw
        self.twin = TorchTwin(RayTwin(profile))
        self.solve = TorchFieldSolver(FieldRecovery(profile))

    def own(self, seed: int) -> Outcome:
        """Draw, simulate and calibrate a device of the project's simulator."""
        device = self._draw(np.random.default_rng(seed))
        simulator = Simulator(self.profile, device, LEVELS, seed)
        references = simulator.references()
        symbols = random_symbols(self.profile, LEVELS, self.pages, np.random.default_rng([seed, 3]))
        seen = [simulator.simulate(page) for page in symbols]
        phasors = [np.exp(1j * symbol_phases(page, LEVELS)) for page in symbols]
        known = [KnownPage(page.pair, page_phasors) for page, page_phasors in zip(seen, phasors, strict=True)]
        truth = self._truth(device, np.mean([page.shift_px for page in seen], axis=0))
        quadrature_phase = device.homodyne.turn_rad
        oracle = float(np.mean([self._coherence(page, references, truth, quadrature_phase) for page in known]))
        return self._outcome(seed, device.geometry.pipe_angle_deg, quadrature_phase, references, known, oracle, truth)

    def foreign(self, seed: int) -> Outcome:
        """Draw a device of the other simulator, and calibrate through a recording."""
        device = ForeignDevice.draw(seed)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "foreign.h5"
            device.write(path, self.pages, LEVELS, seed)
            with Recording.open(path) as recording:
                references = recording.references()
                known = known_pages(recording, self.profile, range(self.pages))
        p = device.parameters
        quadrature_phase = p.quadrature_sign * np.deg2rad(90 + p.quadrature_error_deg)
        return self._outcome(seed, p.pipe_angle_deg, quadrature_phase, references, known, None)

    def _outcome(
        self,
        seed: int,
        angle: float,
        quadrature_phase: float,
        references: FramePair,
        known: list[KnownPage],
        oracle: float | None,
        truth: NDArray[np.float64] | None = None,
    ) -> Outcome:
        start = time.perf_counter()
        try:
            found = calibrate(self.twin, self.solve, self.profile, references, known)
        except CalibrationError as error:
            seconds = time.perf_counter() - start
            return Outcome(seed, angle, oracle_coherence=oracle, seconds=seconds, failure=str(error))
        seconds = time.perf_counter() - start
        return Outcome(
            seed=seed,
            angle_deg=angle,
            angle_error_deg=abs(self._angle(found) - angle),
            turn_error_deg=abs(float(np.rad2deg(np.angle(np.exp(1j * (found.quadrature_phase - quadrature_phase)))))),
            relation_error_px=self._relation_error_px(found.parameters, truth) if truth is not None else None,
            coherence=found.coherence_after,
            oracle_coherence=oracle,
            ratio=found.coherence_after / oracle if oracle else None,
            seconds=seconds,
            verdict=found.goodness.verdict if found.goodness else None,
            bits_lost=found.goodness.bits_lost if found.goodness else None,
            parameters=as_dict(found.parameters),
        )

    def _angle(self, found: Registered) -> float:
        return self.profile.pipe.angle_deg + float(np.rad2deg(found.parameters[NAMES.index("pipe_angle_rad")]))

    def _relation_error_px(self, found: NDArray[np.float64], truth: NDArray[np.float64]) -> float:
        """Return the difference of the cameras' displacements from the truth, root mean square over the page."""
        grid = field_grid(self.profile)
        places = np.stack(np.meshgrid(grid.x_m[::16], grid.y_m[::16]), axis=-1).reshape(-1, 2)
        in_phase, quadrature = self.twin.pixels(found, places) - self.twin.pixels(truth, places)
        return float(np.sqrt(np.mean(np.sum((quadrature - in_phase) ** 2, axis=-1))))

    def _truth(self, device: Device, shift_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """True parameters [P], with the image's mean drift over the pages in both cameras' shifts."""
        values = as_dict(true_parameters(self.profile, device))
        for camera in ("in_phase", "quadrature"):
            values[f"{camera}_shift_x_px"] += float(shift_px[0])
            values[f"{camera}_shift_y_px"] += float(shift_px[1])
        return as_vector(values)

    def _coherence(
        self, page: KnownPage, references: FramePair, parameters: NDArray[np.float64], quadrature_phase: float
    ) -> float:
        registration = registration_coefficients(self.twin, parameters, self.profile)
        homodyne = np.array([np.cos(quadrature_phase), np.sin(quadrature_phase)], dtype=np.float32)
        apart = needed_apart(parameters, self.profile)
        field, _ = self.solve(page.pair, references, registration, homodyne, apart)
        sampler = FieldSampler(field, field_grid(self.profile))
        return page_coherence(sampler, self.twin, parameters, self.profile, page.symbols)
