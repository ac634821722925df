"""Every decoder on the same light, against the oracle: same recording, same held-out pages.

    python -m benchmarks.decoders --angle -0.6 --out runs/decoders
    python -m benchmarks.decoders --arm coherent --size 64x2x0 --size 96x2x1 --steps 1500 --out runs/decoders

Coherent, wave and oracle share network, steps and seeds; refined is coherent, and then looks again. The oracle knows
the simulated truth: geometry, cameras, reference; the signal's own power is taken off its frames; then the wave adjoint
and the same network. None, mode and ray are the published decoders, with their own network and training. Image shift
and piston of every page, held-out ones too, are found from all of its symbols, for each arm alike. Interrupted, it goes
on where it was; all lies in --out.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import click
import numpy as np
from numpy.typing import NDArray
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch.utils.data import Dataset

from benchmarks.decoders_figure import MAP, draw
from benchmarks.oracle import Oracle
from optics.device import Device, Sensor
from optics.files import write_json
from optics.measures import achievable_rate, measure
from optics.page import pilot_mask
from optics.profile import Profile, load_profile
from optics.progress import percent_bar
from optics.recording import Recording, hash_frames
from optics.recording_job import RecordingJob
from optics.registration.calibrate import calibrate
from optics.registration.calibration import Calibration, load_calibration
from optics.registration.known import known_pages
from train.decoder import LOCALIZERS
from train.feature_store import FeatureStore, fill
from train.features import FeatureExtractor, PageFeatures
from train.field import FieldRecovery, TorchFieldSolver
from train.fitting import (
    DecoderTraining,
    Fitted,
    Hyperparameters,
    Page,
    SymbolTraining,
    best_kappa_scale,
    decode_pages,
    fit_network,
    seed_stretch,
    without_piston,
)
from train.patches import training_pages
from train.published.localizers import NAMES as PUBLISHED
from train.published.recipe import published_choices, published_decoder
from train.published.states import page_states
from train.published.training import FramePages, PublishedChoices, PublishedTraining, fit_published
from train.refinement import RefinementPages, fit_prediction, fit_refinements
from train.run import begin, sole_writer
from train.symbols import LIKENESS_PAGES
from train.twin import RayTwin, TorchTwin

LEVELS = 256
ORACLE = "oracle"
REFINED = "refined"
ARMS = (*PUBLISHED, *LOCALIZERS, REFINED, ORACLE)
CALIBRATED = 2
HELD_OUT_SHARE = 0.05
LAST_SHARE = 0.2


def calibrated(profile: Profile, recording: Recording, path: Path) -> Calibration:
    """The calibration from nominal on the recording's first pages, kept in `path`."""
    if not path.exists():
        pages = known_pages(recording, profile, range(CALIBRATED))
        twin, solver = TorchTwin(RayTwin(profile)), TorchFieldSolver(FieldRecovery(profile))
        with percent_bar() as progress:
            fitted = calibrate(twin, solver, profile, recording.references(), pages, progress)
        hashes = [hash_frames(page.pair) for page in pages]
        Calibration.from_registered(fitted, profile, hashes).save(path)
    return load_calibration(path)


@dataclass(frozen=True)
class Bench:
    """What all arms share.

    Attributes:
        recording: open.
        profile, device: nominal and true.
        fitted: the calibration.
        out: folder of everything.
        training, validation, unseen: page numbers.
    """

    recording: Recording
    profile: Profile
    device: Device
    fitted: Calibration
    out: Path
    training: range
    validation: range
    unseen: range

    @classmethod
    def of(cls, recording: Recording, profile: Profile, device: Device, out: Path) -> Bench:
        """Calibrated, and split into pages for training, for validation and for the figures."""
        pages = recording.pages - CALIBRATED
        held, last = max(2, round(HELD_OUT_SHARE * pages)), recording.pages
        return cls(
            recording=recording,
            profile=profile,
            device=device,
            fitted=calibrated(profile, recording, out / "calibration.toml"),
            out=out,
            training=range(CALIBRATED, last - 2 * held),
            validation=range(last - 2 * held, last - held),
            unseen=range(last - held, last),
        )

    @property
    def mask(self) -> NDArray[np.bool_]:
        """Pilots, bool [ny, nx]."""
        return pilot_mask(self.profile)

    @property
    def pages(self) -> list[int]:
        """All that is not calibrated on, in order."""
        return [*self.training, *self.validation, *self.unseen]

    def extractor(self, localizer: str) -> FeatureExtractor:
        """Of the calibrated device."""
        references = self.recording.references()
        return FeatureExtractor(self.profile, self.fitted.vector, self.fitted.turn_rad, references, localizer)

    def symbol_arm(self, name: str, size: str, choices: Hyperparameters) -> Outcome:
        """Features, then the network at symbol pitch."""
        channels, blocks, levels = map(int, size.split("x"))
        choices = replace(choices, channels=channels, blocks=blocks, levels=levels)
        folder, features, first, preparing = self.first_look("coherent" if name == REFINED else name, size, choices)
        if name != REFINED:
            validation, unseen = self.held_out(features)
            return self.outcome(name, size, choices.steps, folder, first, validation, unseen, preparing)
        extractor = self.extractor("coherent")
        known = known_pages(self.recording, self.profile, self.training[:LIKENESS_PAGES])
        prediction = fit_prediction(extractor, self.profile, self.fitted.vector, known)
        counts = len(self.training), len(self.validation)
        material = RefinementPages(self.recording, self.pages, *counts, features)
        key = self.fitted.to_toml()
        refined = fit_refinements(folder, choices, material, extractor, prediction, first, key, devices=1)
        at = folder / f"refinement-{choices.refinements}"
        return self.outcome(
            f"{name} {choices.refinements}",
            size,
            choices.of_refinement().steps,
            at,
            refined.last,
            *self.held_out(at / "features"),
            refined.seconds - refined.last.seconds,
        )

    def first_look(
        self, name: str, size: str, choices: Hyperparameters
    ) -> tuple[Path, Path, Fitted[SymbolTraining], float]:
        """Run, features, trained network, and seconds that the features took."""
        features = self.out / name / "features"
        key = "" if name == ORACLE else self.fitted.to_toml()

        def make(start: int, shift: tuple[float, float]) -> Iterator[PageFeatures]:
            if name == ORACLE:
                return Oracle(self.recording, self.profile, self.device).pages(self.pages[start:], shift)
            return self.extractor(name).pages(self.recording, self.pages[start:], shift)

        preparing = fill(features, key, len(self.pages), make, f"features of {name}")
        training, (validation, _) = FeatureStore(features, range(len(self.training))), self.held_out(features)
        patches = training_pages([training], self.mask, choices.patch)
        folder = self.begun(self.out / name / f"{size}-{choices.steps}", asdict(replace(choices, refinements=0)))
        return (
            folder,
            features,
            fit_network(folder, choices, self.mask, LEVELS, patches, validation, devices=1),
            preparing,
        )

    def held_out(self, features: Path) -> tuple[FeatureStore, FeatureStore]:
        """Features of the validation pages, and of those for the figures."""
        first, last, end = len(self.training), len(self.training) + len(self.validation), len(self.pages)
        return FeatureStore(features, range(first, last)), FeatureStore(features, range(last, end))

    def published_arm(self, name: str, choices: PublishedChoices) -> Outcome:
        """States of the pages, then a published decoder on raw frames."""
        states, preparing = page_states(
            self.out / "states.json", self.fitted.to_toml(), self.recording, self.extractor("coherent"), self.pages
        )
        by_page = dict(zip(self.pages, states, strict=True))
        training, validation, unseen = (
            FramePages(self.recording, part, [by_page[page] for page in part])
            for part in (self.training, self.validation, self.unseen)
        )
        size = "/".join(map(str, choices.channels))
        chosen = asdict(choices) | {"channels": list(choices.channels)}
        folder = self.begun(self.out / name / f"{size.replace('/', '-')}-{choices.steps}", chosen)
        seed_stretch(folder, choices.seed)
        decoder = published_decoder(name, choices, self.profile, self.recording.references(), self.fitted.turn_rad)
        module = PublishedTraining(decoder, choices, self.mask, LEVELS)
        trained = fit_published(folder, module, training, validation, devices=1)
        return self.outcome(name, size, choices.steps, folder, trained, validation, unseen, preparing)

    def begun(self, folder: Path, options: dict[str, Any]) -> Path:
        """The folder of a run that was begun with these options."""
        folder.mkdir(parents=True, exist_ok=True)
        begin(folder, options)
        return folder

    def outcome(
        self,
        name: str,
        size: str,
        steps: int,
        folder: Path,
        trained: Fitted[Any],
        validation: Dataset[Page],
        unseen: Dataset[Page],
        preparing: float,
    ) -> Outcome:
        """Figures of the held-out pages, kappa made honest on the validation pages."""
        module: DecoderTraining[Any] = trained.module
        scale = best_kappa_scale(module, validation, self.mask)
        decoded = [without_piston(p * scale, t, self.mask) for p, t in zip(*decode_pages(module, unseen), strict=True)]
        px, py = np.concatenate([p[:, ~self.mask] for p in decoded], axis=1)
        truth = [self.recording.symbols(page) for page in self.unseen]
        symbols = np.concatenate([page[~self.mask] for page in truth if page is not None])
        figures = measure(np.arctan2(py, px), np.hypot(px, py), symbols, LEVELS)
        by_symbol = np.full(self.profile.page_shape, np.nan)
        rates = achievable_rate(np.arctan2(py, px), np.hypot(px, py), symbols, LEVELS)
        by_symbol[~self.mask] = rates.reshape(len(truth), -1).mean(axis=0)
        np.save(folder / MAP, by_symbol)
        return Outcome(
            run=str(folder.relative_to(self.out.parent)),
            arm=name,
            size=size,
            steps=steps,
            air=figures.air_bits_per_symbol,
            own_mi=figures.own_mi_bits_per_symbol,
            page_kB=figures.air_bits_per_symbol * int((~self.mask).sum()) / 8000,
            validation_air=trained.validation_air,
            gained_in_last_fifth=gained_at_the_end(folder, steps),
            preparing_seconds=preparing,
            training_seconds=trained.seconds,
        )


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
    """What one arm reached with a network of one size. AIR in bits per data symbol, `size` as `--size` has it; `run` is
    its folder."""

    run: str
    arm: str
    size: str
    steps: int
    air: float
    own_mi: float
    page_kB: float
    validation_air: float
    gained_in_last_fifth: float
    preparing_seconds: float
    training_seconds: float
    over_oracle: float | None = None

    def line(self) -> str:
        over = "" if self.over_oracle is None else f"{self.over_oracle:.3f}"
        return (
            f"{self.arm:<10} {self.size:<9} {self.steps:>6} {self.air:>8.3f} {self.own_mi:>7.3f} {self.page_kB:>6.2f} "
            f"{over:>10} {self.gained_in_last_fifth:>8.3f} {self.preparing_seconds / 60:>9.1f} "
            f"{self.training_seconds / 60:>8.1f}"
        )


HEADER = (
    f"{'arm':<10} {'size':<9} {'steps':>6} {'AIR':>8} {'own-MI':>7} {'kB':>6} {'of oracle':>10} {'gained':>8} "
    f"{'features':>9} {'training':>8}"
)
"""Held-out pages, bits a symbol and kB a page; what validation AIR gained in the last fifth of the steps; minutes."""


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
@click.option(
    "--angle", "angles_deg", type=float, multiple=True, default=(-0.6,), show_default=True, help="Pipe angle, degrees."
)
@click.option(
    "--full-well", "full_wells", type=float, multiple=True, default=(32.0,), show_default=True, help="Electrons: noise."
)
@click.option(
    "--symbol-size",
    "symbol_sizes",
    type=click.IntRange(1, 64),
    multiple=True,
    help="Edge of a symbol, modulator pixels; the profile's if left out.",
)
@click.option(
    "--pages", type=click.IntRange(12), default=500, show_default=True, help="With 5% validation, 5% held out."
)
@click.option("--steps", type=click.IntRange(10), default=6000, show_default=True)
@click.option(
    "--size", "sizes", type=Size(), multiple=True, default=(DEFAULT_SIZE,), show_default=True, help="Network."
)
@click.option("--refinements", type=click.IntRange(1, 4), default=1, show_default=True, help="Of the refined arm.")
@click.option(
    "--published-steps",
    type=click.IntRange(10),
    help="Of the published decoders; their authors' 50 passes if left out.",
)
@click.option(
    "--published-channels", type=click.IntRange(4), multiple=True, default=(32,), show_default=True, help="Network."
)
@click.option("--arm", "names", type=click.Choice(ARMS), multiple=True, default=ARMS, show_default=True)
@click.option("--seed", type=click.IntRange(min=0), default=5000, show_default=True)
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder for features, runs, figures.json.")
def main(
    profile_name: str,
    angles_deg: tuple[float, ...],
    full_wells: tuple[float, ...],
    symbol_sizes: tuple[int, ...],
    pages: int,
    steps: int,
    sizes: tuple[str, ...],
    refinements: int,
    published_steps: int | None,
    published_channels: tuple[int, ...],
    names: tuple[str, ...],
    seed: int,
    out: Path,
) -> None:
    """Train every arm on the same pages, light by light, and print what it says of held-out ones."""
    nominal = load_profile(profile_name)
    click.get_current_context().with_resource(sole_writer(out))
    lights: list[dict[str, Any]] = []
    symbol_sizes = symbol_sizes or (nominal.page.symbol_size_px,)
    for angle_deg, full_well, size_px in product(angles_deg, full_wells, symbol_sizes):
        profile = nominal.with_symbols_of(size_px)
        device = Device(sensor=Sensor(full_well_e=full_well)).with_settings([f"geometry.pipe_angle_deg={angle_deg}"])
        folder = out / f"{angle_deg:g}deg-{full_well:g}e-{size_px}px"
        folder.mkdir(exist_ok=True)
        with recorded(profile, device, pages, seed, folder) as recording:
            bench = Bench.of(recording, profile, device, folder)
            runs: list[Callable[[], Outcome]] = []
            for name in names:
                if name in PUBLISHED:
                    authors = replace(published_choices(profile, len(bench.training)), seed=seed)
                    authors = authors if published_steps is None else replace(authors, steps=published_steps)
                    widths = [replace(authors, channels=(width, 2 * width)) for width in published_channels]
                    runs += [partial(bench.published_arm, name, choices) for choices in widths]
                else:
                    common = Hyperparameters(steps=steps, seed=seed, refinements=refinements)
                    runs += [partial(bench.symbol_arm, name, size, common) for size in sizes]
            outcomes: list[Outcome] = []
            for run in runs:
                outcomes = compared([*outcomes, run()])
                light = {
                    "angle_deg": angle_deg,
                    "angle_error_deg": bench.fitted.angle_deg(profile) - angle_deg,
                    "full_well_e": full_well,
                    "symbol_size_px": size_px,
                    "outcomes": [asdict(outcome) for outcome in outcomes],
                }
                write_json(out / "figures.json", {"pages": pages, "seed": seed, "lights": [*lights, light]})
                draw([*lights, light], out)
        lights.append(light)
        click.echo(f"\n{angle_deg:g} degree, full well {full_well:g} e-, symbols of {size_px}x{size_px} pixels")
        click.echo("\n".join([HEADER, *(outcome.line() for outcome in outcomes)]))


@contextmanager
def recorded(profile: Profile, device: Device, pages: int, seed: int, folder: Path) -> Iterator[Recording]:
    """The recording of a light, with pages to calibrate on before the others; made if it is not there."""
    begin(folder, {"--profile": profile.to_toml(), "device": device.model_dump(), "--pages": pages, "--seed": seed})
    path = folder / "recording.h5"
    if not path.exists():
        job = RecordingJob(profile, device, LEVELS, seed, truth=True, out=path)
        job.claim(force=False)
        job.run(pages + CALIBRATED)
    with Recording.open(path) as recording:
        yield recording


def compared(outcomes: list[Outcome]) -> list[Outcome]:
    """The outcomes with their share of what the oracle reached, with a network of the same size if there was one."""
    oracles = {outcome.size: outcome.air for outcome in outcomes if outcome.arm == ORACLE}
    if not oracles:
        return outcomes
    best = max(oracles.values())
    return [replace(outcome, over_oracle=outcome.air / oracles.get(outcome.size, best)) for outcome in outcomes]


if __name__ == "__main__":
    main()
