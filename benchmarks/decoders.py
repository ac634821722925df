"""Decoders against the oracle on the same light: same pages, same network, same steps and seeds.

    python -m benchmarks.decoders --angle -0.6 --out runs/decoders

The oracle knows the simulated truth: geometry, cameras, reference; the signal's own power is taken off its frames; then
the wave adjoint and the same network. Interrupted, it goes on where it was: features and checkpoints lie in --out.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
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


@click.command()
@click.option("--profile", "profile_name", default="bench", show_default=True, help="Shipped profile or TOML file.")
@click.option("--angle", "angle_deg", type=float, default=-0.6, show_default=True, help="Pipe angle, degrees.")
@click.option("--full-well", type=float, default=32.0, show_default=True, help="Electrons; sets the noise.")
@click.option(
    "--pages", type=click.IntRange(12), default=240, show_default=True, help="With 8% validation, 8% held out."
)
@click.option("--steps", type=click.IntRange(10), default=6000, show_default=True)
@click.option("--channels", type=click.IntRange(4), default=Hyperparameters.channels, show_default=True)
@click.option("--arm", "names", type=click.Choice(ARMS), multiple=True, default=ARMS, show_default=True)
@click.option("--seed", type=click.IntRange(min=0), default=5000, show_default=True)
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder for features, runs, figures.json.")
def main(
    profile_name: str,
    angle_deg: float,
    full_well: float,
    pages: int,
    steps: int,
    channels: int,
    names: tuple[str, ...],
    seed: int,
    out: Path,
) -> None:
    """Train every arm on the same pages and print held-out AIR."""
    profile = load_profile(profile_name)
    device = Device(sensor=Sensor(full_well_e=full_well)).with_settings([f"geometry.pipe_angle_deg={angle_deg}"])
    choices = Hyperparameters(steps=steps, seed=seed, channels=channels)
    options = {"--profile": profile.to_toml(), "device": device.model_dump(), "--pages": pages, **asdict(choices)}
    click.get_current_context().with_resource(sole_writer(out))
    begin(out, options)
    written = list(random_symbols(profile, LEVELS, pages + CALIBRATED, np.random.default_rng([seed, 7])))

    def simulator() -> Simulator:
        return Simulator(profile, device, LEVELS, seed)

    fitted = calibrated(profile, simulator(), written[:CALIBRATED], out / "calibration.toml")
    figures: dict[str, object] = {
        "angle_deg": angle_deg,
        "angle_error_deg": fitted.angle_deg(profile) - angle_deg,
        "full_well_e": full_well,
        "pages": pages,
        "steps": steps,
        "channels": channels,
        "seed": seed,
    }
    mask = pilot_mask(profile)
    held = max(2, round(HELD_OUT_SHARE * pages))
    first = pages - 2 * held
    rates: dict[str, float] = {}
    for arm in arms(profile, device, fitted, simulator().references(), names):
        folder = out / arm.name
        key = f"{angle_deg} {full_well} {seed} {fitted.to_toml() if arm.name != 'oracle' else ''}"
        preparing = fill(
            folder / "features",
            key,
            pages,
            lambda start, shift, arm=arm: arm.features(simulator(), written[CALIBRATED:], start, shift),  # type: ignore[misc]
            f"features of {arm.name}",
        )
        training, validation, unseen = (
            FeatureStore(folder / "features", part)
            for part in (range(first), range(first, first + held), range(first + held, pages))
        )
        trained = fit_network(folder, choices, mask, LEVELS, training, validation, devices=1)
        p, phases = decode_pages(trained.module, unseen)
        rates[arm.name] = held_out_air(p, phases, mask, LEVELS)
        figures |= {
            f"{arm.name}_air": rates[arm.name],
            f"{arm.name}_validation_air": trained.validation_air,
            f"{arm.name}_preparing_seconds": preparing,
            f"{arm.name}_training_seconds": trained.seconds,
            f"{arm.name}_gained_in_last_fifth": gained_at_the_end(folder, steps),
        }
        click.echo(
            f"{arm.name:<10} held-out AIR {rates[arm.name]:.3f} bits/symbol; validation AIR gained "
            f"{figures[f'{arm.name}_gained_in_last_fifth']:.3f} in the last fifth of {steps} steps; "
            f"{trained.seconds / 60:.1f} min after {preparing / 60:.1f} min for simulation and features"
        )
        for name in rates:
            if "oracle" in rates and name != "oracle":
                figures[f"{name}_over_oracle"] = rates[name] / rates["oracle"]
        write_json(out / "figures.json", figures)
    for name in rates:
        if f"{name}_over_oracle" in figures:
            click.echo(f"{name:<10} over the oracle {figures[f'{name}_over_oracle']:.3f}")


if __name__ == "__main__":
    main()
