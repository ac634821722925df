"""Decoders against the oracle on the same light: same pages, same network, same steps and seeds.

    python -m benchmarks.decoders --angle -0.6 --out runs/decoders
    python -m benchmarks.decoders --arm coherent --size 64x2x0 --size 96x2x1 --steps 1500 --out runs/decoders

The oracle knows the simulated truth: geometry, cameras, reference; the signal's own power is taken off its frames; then
the wave adjoint and the same network. Image shift and piston of every page, held-out ones too, are found from all of
its symbols, for each arm alike. Interrupted, it goes on where it was: features and checkpoints lie in --out.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from optics.cameras import resample
from optics.device import Device, Sensor
from optics.files import write_json
from optics.page import pilot_mask, random_symbols, symbol_phases
from optics.profile import Profile, load_profile
from optics.progress import percent_bar
from optics.recording import FramePair, hash_frames
from optics.registration.calibrate import KnownPage, calibrate
from optics.registration.calibration import Calibration, load_calibration
from optics.simulator import SimulatedPage, Simulator, TrueOptics, true_parameters
from train.feature_store import FeatureStore, fill
from train.features import FeatureExtractor, PageFeatures
from train.field import FieldRecovery, TorchFieldSolver
from train.fitting import Hyperparameters, decode_pages, fit_network, held_out_air
from train.run import begin, sole_writer
from train.twin import RayTwin, TorchTwin

LEVELS = 256
ARMS = ("coherent", "wave", "oracle")
CALIBRATED = 2
HELD_OUT_SHARE = 0.08
LAST_SHARE = 0.2


def without_signal_power(page: SimulatedPage, optics: TrueOptics) -> FramePair:
    """The frames of a page with the counts that |E|^2 adds taken off, noise and quantisation left in, float32."""
    device = optics.device
    power = np.abs(optics.camera_field(page.exit_field)) ** 2
    counts = optics.electrons_per_unit * (2**device.sensor.bit_depth - 1) / device.sensor.full_well_e
    frames = []
    for frame, pose, gain in (
        (page.pair.in_phase, device.in_phase_camera, 1.0),
        (page.pair.quadrature, device.quadrature_camera, device.homodyne.quadrature_gain),
    ):
        seen = resample(power, *optics.camera_axes_m, *optics.view(pose, page.shift_px))
        frames.append((frame - gain * counts * seen).astype(np.float32))
    return FramePair(*frames)


@dataclass(frozen=True)
class Arm:
    """One decoder's way from frames to features.

    Attributes:
        name: of the decoder.
        extractor: with the geometry that it may know.
        without_power: whether it may know what |E|^2 added to the frames.
    """

    name: str
    extractor: FeatureExtractor
    without_power: bool = False

    def features(
        self, simulator: Simulator, pages: list[NDArray[np.uint8]], first: int, shift_px: tuple[float, float]
    ) -> Iterator[PageFeatures]:
        """Features of the pages from `first` on, by a simulator that has written none; `shift_px` was the last."""
        simulator.skip(first)
        shift = np.array(shift_px)
        for symbols in pages[first:]:
            seen = simulator.simulate(symbols)
            pair = without_signal_power(seen, simulator.optics) if self.without_power else seen.pair
            phases = symbol_phases(symbols, LEVELS)
            features, shift = self.extractor.page(self.extractor.field(pair), phases, shift)
            yield features


def calibrated(profile: Profile, simulator: Simulator, known: list[NDArray[np.uint8]], path: Path) -> Calibration:
    """The calibration from nominal on known pages, kept in `path`."""
    if not path.exists():
        pages = [KnownPage(simulator.page(page), np.exp(1j * symbol_phases(page, LEVELS))) for page in known]
        twin, solver = TorchTwin(RayTwin(profile)), TorchFieldSolver(FieldRecovery(profile))
        with percent_bar() as progress:
            fitted = calibrate(twin, solver, profile, simulator.references(), pages, progress)
        hashes = [hash_frames(page.pair) for page in pages]
        Calibration.from_registered(fitted, profile, hashes).save(path)
    return load_calibration(path)


def arms(
    profile: Profile, device: Device, fitted: Calibration, references: FramePair, names: Sequence[str]
) -> list[Arm]:
    """The decoders of these names, each with what it may know."""
    truth = true_parameters(profile, device)
    made = []
    for name in names:
        if name == "oracle":
            turn = device.homodyne.turn_rad
            extractor = FeatureExtractor(profile, truth, turn, references, "wave", with_signal_power=False)
        else:
            extractor = FeatureExtractor(profile, fitted.vector, fitted.turn_rad, references, name)
        made.append(Arm(name, extractor, without_power=name == "oracle"))
    return made


def gained_at_the_end(run: Path, steps: int) -> float:
    """Validation AIR that the best of the last fifth of a run's steps has over the best before, bits."""
    events = EventAccumulator(str(run / "tensorboard"))
    events.Reload()
    seen = [(event.step, event.value) for event in events.Scalars("val_air")]
    late = [value for step, value in seen if step > (1 - LAST_SHARE) * steps]
    early = [value for step, value in seen if step <= (1 - LAST_SHARE) * steps]
    return max(late) - max(early) if late and early else float("nan")


@dataclass(frozen=True)
class Outcome:
    """What one arm reached with a network of one size. AIR in bits per data symbol, `size` as `--size` has it."""

    arm: str
    size: str
    air: float
    validation_air: float
    gained_in_last_fifth: float
    preparing_seconds: float
    training_seconds: float
    over_oracle: float | None = None

    def line(self) -> str:
        over = "" if self.over_oracle is None else f"{self.over_oracle:.3f}"
        return (
            f"{self.arm:<10} {self.size:<9} {self.air:>8.3f} {over:>10} {self.gained_in_last_fifth:>8.3f} "
            f"{self.preparing_seconds / 60:>9.1f} {self.training_seconds / 60:>8.1f}"
        )


HEADER = f"{'arm':<10} {'size':<9} {'held out':>8} {'of oracle':>10} {'gained':>8} {'features':>9} {'training':>8}"
"""AIR on held-out pages; what validation AIR gained in the last fifth of the steps; minutes (simulation: features)."""


class Size(click.ParamType[str]):
    """Channels, blocks and levels of a network, e.g. ``96x2x0``."""

    name = "channels x blocks x levels"

    def convert(self, value: str, param: click.Parameter | None, ctx: click.Context | None) -> str:
        if not re.fullmatch(r"[1-9]\d*x[1-9]\d*x\d", value):
            self.fail(f"{value!r}: wanted CHANNELSxBLOCKSxLEVELS, as {DEFAULT_SIZE}", param, ctx)
        return value


DEFAULT_SIZE = f"{Hyperparameters.channels}x{Hyperparameters.blocks}x{Hyperparameters.levels}"


@click.command()
@click.option("--profile", "profile_name", default="bench", show_default=True, help="Shipped profile or TOML file.")
@click.option("--angle", "angle_deg", type=float, default=-0.6, show_default=True, help="Pipe angle, degrees.")
@click.option("--full-well", type=float, default=32.0, show_default=True, help="Electrons; sets the noise.")
@click.option(
    "--pages", type=click.IntRange(12), default=240, show_default=True, help="With 8% validation, 8% held out."
)
@click.option("--steps", type=click.IntRange(10), default=6000, show_default=True)
@click.option(
    "--size", "sizes", type=Size(), multiple=True, default=(DEFAULT_SIZE,), show_default=True, help="Network."
)
@click.option("--arm", "names", type=click.Choice(ARMS), multiple=True, default=ARMS, show_default=True)
@click.option("--seed", type=click.IntRange(min=0), default=5000, show_default=True)
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder for features, runs, figures.json.")
def main(
    profile_name: str,
    angle_deg: float,
    full_well: float,
    pages: int,
    steps: int,
    sizes: tuple[str, ...],
    names: tuple[str, ...],
    seed: int,
    out: Path,
) -> None:
    """Train every arm on the same pages and print held-out AIR."""
    profile = load_profile(profile_name)
    device = Device(sensor=Sensor(full_well_e=full_well)).with_settings([f"geometry.pipe_angle_deg={angle_deg}"])
    options = {"--profile": profile.to_toml(), "device": device.model_dump(), "--pages": pages, "--seed": seed}
    click.get_current_context().with_resource(sole_writer(out))
    begin(out, options)
    written = list(random_symbols(profile, LEVELS, pages + CALIBRATED, np.random.default_rng([seed, 7])))

    def simulator() -> Simulator:
        return Simulator(profile, device, LEVELS, seed)

    fitted = calibrated(profile, simulator(), written[:CALIBRATED], out / "calibration.toml")
    mask = pilot_mask(profile)
    held = max(2, round(HELD_OUT_SHARE * pages))
    first = pages - 2 * held
    outcomes: list[Outcome] = []
    for arm in arms(profile, device, fitted, simulator().references(), names):
        features = out / arm.name / "features"
        key = f"{angle_deg} {full_well} {seed} {fitted.to_toml() if arm.name != 'oracle' else ''}"
        preparing = fill(
            features,
            key,
            pages,
            lambda start, shift, arm=arm: arm.features(simulator(), written[CALIBRATED:], start, shift),  # type: ignore[misc]
            f"features of {arm.name}",
        )
        training, validation, unseen = (
            FeatureStore(features, part)
            for part in (range(first), range(first, first + held), range(first + held, pages))
        )
        for size in sizes:
            channels, blocks, levels = map(int, size.split("x"))
            choices = Hyperparameters(steps=steps, seed=seed, channels=channels, blocks=blocks, levels=levels)
            folder = out / arm.name / f"{size}-{steps}"
            folder.mkdir(exist_ok=True)
            begin(folder, asdict(choices))
            trained = fit_network(folder, choices, mask, LEVELS, training, validation, devices=1)
            p, phases = decode_pages(trained.module, unseen)
            outcomes.append(
                Outcome(
                    arm.name,
                    size,
                    held_out_air(p, phases, mask, LEVELS),
                    trained.validation_air,
                    gained_at_the_end(folder, steps),
                    preparing,
                    trained.seconds,
                )
            )
            outcomes = against_oracle(outcomes)
            figures = {
                "angle_deg": angle_deg,
                "angle_error_deg": fitted.angle_deg(profile) - angle_deg,
                "full_well_e": full_well,
                "pages": pages,
                "steps": steps,
                "seed": seed,
                "outcomes": [asdict(outcome) for outcome in outcomes],
            }
            write_json(out / "figures.json", figures)
    click.echo("\n".join([HEADER, *(outcome.line() for outcome in outcomes)]))


def against_oracle(outcomes: list[Outcome]) -> list[Outcome]:
    """The outcomes with their share of what the oracle reached with a network of the same size, where it was run."""
    oracle = {outcome.size: outcome.air for outcome in outcomes if outcome.arm == "oracle"}
    return [
        replace(outcome, over_oracle=outcome.air / oracle[outcome.size]) if outcome.size in oracle else outcome
        for outcome in outcomes
    ]


if __name__ == "__main__":
    main()
