"""Calibration from nominal on devices drawn over the whole capture range: angle errors, coherence, time.

    python -m analysis.comparison.calibration --devices 20 --first-seed 1000 --pages 2 --json F
    python -m analysis.comparison.calibration --devices 3 --foreign --json F
    python -m analysis.comparison.calibration --symbol-size 2 --devices 3 --json F

The coherence of the calibrated geometry is put in ratio to that of the true one (the oracle), fields recovered with
the true cameras and turn, the image's drift included. The cameras' relation is how far the quadrature camera is placed
wrong against the in-phase one, root mean square over the page: the field that is recovered from both depends on it. A
foreign device comes from a simulator that shares nothing with this project; its true geometry has other parameters, so
it has neither. An interrupted run goes on where it stopped: seeds that are in the JSON file are not computed again,
failed ones are; a file of another format of runs (`lightpage.train.runs.FORMAT`) is refused.
"""

from __future__ import annotations

import hashlib
import json
import statistics
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray

from analysis.foreign_device import ForeignDevice
from lightpage.calibration.calibrate import KnownPage, Registered, calibrate
from lightpage.calibration.coherence import page_coherence
from lightpage.calibration.known_pages import known_pages
from lightpage.calibration.parameters import NAMES, as_dict, as_vector
from lightpage.calibration.samplers import FieldSampler
from lightpage.calibration.sampling_table import registration_coefficients
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.device.profile import Profile, load_profile
from lightpage.device.state import Device, draw_device
from lightpage.errors import CalibrationError, InvalidInputError
from lightpage.files import write_json
from lightpage.page.symbols import random_symbols, symbol_phases
from lightpage.progress import track
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.reader import Recording
from lightpage.simulator.simulator import Simulator
from lightpage.simulator.true_optics import true_parameters
from lightpage.train.models.field import FieldRecovery, TorchFieldSolver
from lightpage.train.models.twin import RayTwin, TorchTwin
from lightpage.train.runs import FORMAT
from lightpage.waves.grid import field_grid

LEVELS = 256
WANTED_SHARE = 0.95
"""Of the oracle's coherence, for a device to count as found."""


@dataclass(frozen=True)
class Outcome:
    """One device. Angles in degrees; what could not be measured is None."""

    seed: int
    angle_deg: float
    angle_error_deg: float | None = None
    turn_error_deg: float | None = None
    relation_error_px: float | None = None
    coherence: float | None = None
    oracle_coherence: float | None = None
    ratio: float | None = None
    seconds: float | None = None
    parameters: dict[str, float] | None = None
    failure: str | None = None

    def line(self) -> str:
        def show(value: float | None, form: str) -> str:
            return format(value, form) if value is not None else format("-", form.partition(".")[0].lstrip("+"))

        text = (
            f"{self.seed:>6} {self.angle_deg:>+9.4f} {show(self.angle_error_deg, '>9.4f')} "
            f"{show(self.turn_error_deg, '>9.2f')} {show(self.relation_error_px, '>8.2f')} "
            f"{show(self.coherence, '>9.4f')} {show(self.oracle_coherence, '>9.4f')} "
            f"{show(self.ratio, '>7.3f')} {show(self.seconds, '>7.1f')}"
        )
        return f"{text}  {self.failure}" if self.failure else text


HEADER = (
    f"{'seed':>6} {'angle':>9} {'error':>9} {'Q phase':>9} {'relation':>8} "
    f"{'coherence':>9} {'oracle':>9} {'ratio':>7} {'seconds':>7}"
)


class Bench:
    """The nominal device with its twin and field solver, which every device shares."""

    def __init__(self, profile: Profile, pages: int) -> None:
        self.profile, self.pages = profile, pages
        self.twin = TorchTwin(RayTwin(profile))
        self.solve = TorchFieldSolver(FieldRecovery(profile))

    def own(self, seed: int) -> Outcome:
        """Draw, simulate and calibrate a device of the project's simulator."""
        device = draw_device(np.random.default_rng(seed))
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
            parameters=as_dict(found.parameters),
        )

    def _angle(self, found: Registered) -> float:
        return self.profile.pipe.angle_deg + float(np.rad2deg(found.parameters[NAMES.index("pipe_angle_rad")]))

    def _relation_error_px(self, found: NDArray[np.float64], truth: NDArray[np.float64]) -> float:
        """What of the cameras' displacements from the truth is not common to both, root mean square over the page."""
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
        field, _ = self.solve(page.pair, references, registration, homodyne)
        sampler = FieldSampler(field, field_grid(self.profile))
        return page_coherence(sampler, self.twin, parameters, self.profile, page.symbols)


def summary(outcomes: list[Outcome]) -> dict[str, float | int | None]:
    """Worst and median over the devices that were calibrated; shares over all."""
    errors = [o.angle_error_deg for o in outcomes if o.angle_error_deg is not None]
    seconds = [o.seconds for o in outcomes if o.seconds is not None]
    with_oracle = [o for o in outcomes if o.oracle_coherence is not None]
    near = sum(1 for o in with_oracle if o.ratio is not None and o.ratio >= WANTED_SHARE)
    relations = [o.relation_error_px for o in outcomes if o.relation_error_px is not None]
    ratios = [o.ratio for o in with_oracle if o.ratio is not None]
    return {
        "devices": len(outcomes),
        "calibrated": len(errors),
        "angle_error_deg_worst": max(errors, default=None),
        "angle_error_deg_median": statistics.median(errors) if errors else None,
        "near_oracle": near if with_oracle else None,
        "near_oracle_share": near / len(with_oracle) if with_oracle else None,
        "ratio_worst": min(ratios, default=None),
        "relation_error_px_worst": max(relations, default=None),
        "relation_error_px_median": statistics.median(relations) if relations else None,
        "seconds_median": statistics.median(seconds) if seconds else None,
        "seconds_worst": max(seconds, default=None),
    }


def load(path: Path, settings: dict[str, object]) -> dict[int, Outcome]:
    """Outcomes by seed of an earlier run with the same settings.

    Raises:
        InvalidInputError: the file is something else, or of other settings.
    """
    if not path.exists():
        return {}
    try:
        data = json.loads(path.read_text("utf-8"))
        found, outcomes = data["settings"], {o["seed"]: Outcome(**o) for o in data["outcomes"]}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InvalidInputError(f"--json {path}", error, "a file of this benchmark, or a new name") from None
    if found != settings:
        raise InvalidInputError(f"--json {path}", f"results of {found}", f"results of {settings}, or a new name")
    return outcomes


@click.command()
@click.option("--profile", "profile_name", default="bench", show_default=True)
@click.option(
    "--symbol-size", type=click.IntRange(1, 64), help="Edge of a symbol, modulator pixels.  [default: the profile's]"
)
@click.option("--devices", default=20, show_default=True, type=click.IntRange(1))
@click.option("--first-seed", default=1000, show_default=True, type=click.IntRange(0))
@click.option("--pages", default=2, show_default=True, type=click.IntRange(1, 4), help="Known pages a device.")
@click.option("--foreign", is_flag=True, help="Devices of the other simulator.")
@click.option("--json", "json_path", required=True, type=OutputFile())
def main(
    profile_name: str,
    symbol_size: int | None,
    devices: int,
    first_seed: int,
    pages: int,
    foreign: bool,
    json_path: Path,
) -> None:
    """Calibrate drawn devices and compare with the truth."""
    profile = load_profile(profile_name)
    if symbol_size is not None:
        if foreign:
            raise InvalidInputError(
                "--symbol-size", f"{symbol_size} with --foreign", "one of them: its pages are its own"
            )
        profile = profile.with_symbols_of(symbol_size)
    settings: dict[str, object] = {"format": FORMAT, "pages": pages, "foreign": foreign}
    settings |= {"profile": profile_name, "profile_sha256": hashlib.sha256(profile.to_toml().encode()).hexdigest()}
    done = {seed: o for seed, o in load(json_path, settings).items() if o.failure is None}
    bench = Bench(profile, pages)
    click.echo(HEADER)
    seeds = range(first_seed, first_seed + devices)
    for seed in track(seeds, "calibrate", unit="device"):
        if seed not in done:
            done[seed] = bench.foreign(seed) if foreign else bench.own(seed)
            document = {"settings": settings, "outcomes": [asdict(done[s]) for s in sorted(done)]}
            write_json(json_path, document)
        click.echo(done[seed].line())
    figures = summary([done[seed] for seed in seeds])
    document = {"settings": settings, "summary": figures, "outcomes": [asdict(done[s]) for s in sorted(done)]}
    write_json(json_path, document)
    for name, value in figures.items():
        click.echo(f"{name:<24} {value if not isinstance(value, float) else format(value, '.4g')}")


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.comparison.calibration"))
