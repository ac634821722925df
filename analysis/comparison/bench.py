"""What all methods of a comparison share: their pages, features and trainings, and what each came to."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import click
import numpy as np
from numpy.typing import NDArray
from torch.utils.data import Dataset

from analysis.comparison.data_set import CALIBRATED, LEVELS, calibrated, recorded
from analysis.comparison.decoders_figure import MAP
from analysis.comparison.levels import LevelFigures, level_figures
from analysis.comparison.oracle import Oracle
from analysis.comparison.outcome import Outcome, gained_at_the_end, symbols_by_walls
from analysis.comparison.weight_store import CALIBRATION, WeightStore
from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.document import Calibration
from lightpage.calibration.known_pages import known_pages
from lightpage.device.profile import Profile
from lightpage.device.state import Device
from lightpage.metrics.information import achievable_rate, own_information, page_kilobytes
from lightpage.metrics.measures import measure
from lightpage.page.symbols import pilot_mask
from lightpage.recording.reader import Recording
from lightpage.simulator.true_optics import perfectly_calibrated
from lightpage.train.data.feature_store import FeatureStore, fill
from lightpage.train.data.features import FeatureExtractor, PageFeatures
from lightpage.train.data.known_light import explained
from lightpage.train.data.pages import Page
from lightpage.train.data.patches import training_pages
from lightpage.train.fitting.concentration_scale import best_kappa_scale, decode_pages
from lightpage.train.fitting.fit import fit_network
from lightpage.train.fitting.fitted import Fitted
from lightpage.train.fitting.modules import DecoderTraining, SymbolTraining
from lightpage.train.fitting.validation import without_piston
from lightpage.train.models.decoder import LOCALIZERS
from lightpage.train.models.hyperparameters import Hyperparameters
from lightpage.train.models.prediction import Prediction
from lightpage.train.models.presets import FAST, PRESETS
from lightpage.train.processes import ONE
from lightpage.train.published.localizers import NAMES as PUBLISHED
from lightpage.train.published.states import page_states
from lightpage.train.published.trainer import train_published
from lightpage.train.published.training import FramePages, PublishedChoices
from lightpage.train.runs import begin
from lightpage.train.trainers.refinement import RefinementPages, fit_prediction, fit_refinements, refined_pages
from lightpage.train.trainers.symbols import MATCHED_PAGES

Real = NDArray[np.float64]

ORACLE = "oracle"
REFINED = "refined"
WAVE_REFINED = "wave-refined"
ORACLE_REFINED = "oracle-refined"
FIRST_PASSES = {REFINED: "coherent", WAVE_REFINED: "wave", ORACLE_REFINED: ORACLE}
"""Methods that make another pass, and the method whose first pass they share."""

METHODS = (*PUBLISHED, *LOCALIZERS, FAST, REFINED, WAVE_REFINED, ORACLE, ORACLE_REFINED)
HELD_OUT_SHARE = 0.05
LEVEL_PAGES = 4
"""Of each number of levels, and as many as are calibrated on: thirty thousand symbols on the bench device."""


@dataclass(frozen=True)
class Bench:
    """What all methods share.

    Attributes:
        recording: open.
        profile, device: nominal and true.
        fitted: the calibration.
        out: folder of everything.
        training, validation, unseen: page numbers.
        levels: numbers of levels of further recordings, on which confidences are judged.
        seed: of the recording; theirs follow.
        kept: of this data set.
    """

    recording: Recording
    profile: Profile
    device: Device
    fitted: Calibration
    out: Path
    training: range
    validation: range
    unseen: range
    levels: tuple[int, ...]
    seed: int
    kept: WeightStore

    @classmethod
    def of(
        cls,
        recording: Recording,
        profile: Profile,
        device: Device,
        levels: tuple[int, ...],
        seed: int,
        kept: WeightStore,
    ) -> Bench:
        """Calibrated, and split into pages for training, for validation and for the figures."""
        kept.bring_calibration()
        pages = recording.pages - CALIBRATED
        held, last = max(2, round(HELD_OUT_SHARE * pages)), recording.pages
        return cls(
            recording=recording,
            profile=profile,
            device=device,
            fitted=calibrated(profile, recording, kept.data_set / CALIBRATION),
            out=kept.data_set,
            training=range(CALIBRATED, last - 2 * held),
            validation=range(last - 2 * held, last - held),
            unseen=range(last - held, last),
            levels=levels,
            seed=seed,
            kept=kept,
        )

    @property
    def mask(self) -> NDArray[np.bool_]:
        """Pilots, bool [ny, nx]."""
        return pilot_mask(self.profile)

    @property
    def pages(self) -> list[int]:
        """All that is not calibrated on, in order."""
        return [*self.training, *self.validation, *self.unseen]

    def calibrated_device(self, method: str = "") -> CalibratedDevice:
        """The device as a method knows it: fitted, or true."""
        references = self.recording.references()
        if method == ORACLE:
            return perfectly_calibrated(self.profile, self.device, references)
        return CalibratedDevice.of(self.profile, self.fitted, references)

    def extractor(self, method: str) -> FeatureExtractor:
        """Of the calibrated device; the true one for an oracle's further pass, the signal's power left in."""
        localizer = "coherent" if method in (ORACLE, FAST) else method
        return FeatureExtractor(
            self.calibrated_device(method), localizer, PRESETS[FAST].choices if method == FAST else None
        )

    def symbol_method(self, name: str, size: str, choices: Hyperparameters) -> Outcome:
        """Features, then the network at symbol pitch."""
        if name == FAST:
            choices = replace(PRESETS[FAST].choices, steps=choices.steps, seed=choices.seed)
            size = f"{choices.channels}x{choices.blocks}x{choices.depth}"
        else:
            channels, blocks, depth = map(int, size.split("x"))
            choices = replace(choices, channels=channels, blocks=blocks, depth=depth)
        base = FIRST_PASSES.get(name, name)
        folder, features, first, preparing = self.first_pass(base, size, choices)
        self.kept.keep(folder, first, self.held_out(features)[0])
        if name not in FIRST_PASSES:
            drawn = choices.drawn(self.profile.page_shape)
            outcome = self.outcome(name, size, choices.steps, folder, first, *self.held_out(features), preparing, drawn)
            return replace(outcome, by_levels=self.at_levels(name, folder, [first], outcome.kappa_scale))
        extractor = self.extractor(base)
        pages = known_pages(self.recording, self.profile, self.training[:MATCHED_PAGES])
        prediction = fit_prediction(extractor, explained(extractor, pages))
        counts = len(self.training), len(self.validation)
        inputs = RefinementPages(self.recording, self.pages, *counts, features)
        key = self.key(base)
        refined = fit_refinements(folder, choices, inputs, extractor, prediction, first, key, processes=ONE)
        for number, one in enumerate(refined.trained, 1):
            run = folder / f"refinement-{number}"
            self.kept.keep(run, one, self.held_out(run / "features")[0])
        at = folder / f"refinement-{choices.refinements}"
        held_out = self.held_out(at / "features")
        preparing = refined.seconds - sum(one.seconds for one in refined.trained)
        again = choices.of_refinement()
        drawn = again.drawn(self.profile.page_shape)
        method = f"{name} {choices.refinements}"
        outcome = self.outcome(method, size, again.steps, at, refined.last, *held_out, preparing, drawn)
        passes = [first, *refined.trained]
        by_levels = self.at_levels(base, at, passes, outcome.kappa_scale, prediction)
        return replace(outcome, passes=len(passes), by_levels=by_levels)

    def at_levels(
        self,
        name: str,
        folder: Path,
        passes: list[Fitted[SymbolTraining]],
        scale: float,
        prediction: Prediction | None = None,
    ) -> list[LevelFigures]:
        """What a decoder is worth among fewer levels, on recordings of their own."""
        found = []
        for levels in self.levels:
            at = folder / f"levels-{levels}"
            with recorded(
                self.profile, self.device, LEVEL_PAGES, self.seed + levels, self.out / at.name, levels
            ) as pages:
                numbers = list(range(pages.pages))
                make_first = partial(self.features_of, name, pages, numbers)
                fill(at / "pass-0", self.key(name), len(numbers), make_first, f"pages of {levels} levels")
                for number in range(1, len(passes)):
                    assert prediction is not None
                    earlier = at / f"pass-{number - 1}"
                    inputs = RefinementPages(pages, numbers, len(numbers), 0, earlier)
                    make = partial(
                        refined_pages,
                        self.extractor(name),
                        prediction,
                        inputs,
                        FeatureStore(earlier),
                        passes[number - 1].module,
                    )
                    key = f"{self.key(name)} {passes[number - 1].validation_air}"
                    fill(at / f"pass-{number}", key, len(numbers), make, f"pass {number} over pages of {levels} levels")
                last = FeatureStore(at / f"pass-{len(passes) - 1}")
                found.append(level_figures(self.decoded(passes[-1].module, last, scale), pages, numbers, self.mask))
        return found

    def key(self, name: str) -> str:
        """What the features of a method depend on, beside the recording."""
        if name == ORACLE:
            return ""
        return self.fitted.to_toml() + (PRESETS[FAST].choices.first_pass if name == FAST else "")

    def features_of(
        self, name: str, recording: Recording, pages: Sequence[int], start: int, shift: tuple[float, float]
    ) -> Iterator[PageFeatures]:
        """First passes of a method at pages from one on, in their order; the image had moved by `shift` before."""
        if name == ORACLE:
            return Oracle(recording, self.profile, self.device).pages(pages[start:], shift)
        return self.extractor(name).pages(recording, pages[start:], shift)

    def first_pass(
        self, name: str, size: str, choices: Hyperparameters
    ) -> tuple[Path, Path, Fitted[SymbolTraining], float]:
        """Run, features, trained network, and seconds that the features took."""
        features = self.out / name / "features"
        make = partial(self.features_of, name, self.recording, self.pages)
        preparing = fill(features, self.key(name), len(self.pages), make, f"features of {name}")
        training, (validation, _) = FeatureStore(features, range(len(self.training))), self.held_out(features)
        patches = training_pages([training], self.mask, choices)
        folder = self.begun(self.out / name / f"{size}-{choices.steps}", asdict(replace(choices, refinements=0)))
        return (
            folder,
            features,
            fit_network(folder, choices, self.mask, LEVELS, patches, validation, processes=ONE),
            preparing,
        )

    def held_out(self, features: Path) -> tuple[FeatureStore, FeatureStore]:
        """Features of the validation pages, and of those for the figures."""
        first, last, end = len(self.training), len(self.training) + len(self.validation), len(self.pages)
        return FeatureStore(features, range(first, last)), FeatureStore(features, range(last, end))

    def published_method(self, name: str, choices: PublishedChoices) -> Outcome:
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
        phase = self.fitted.turn_rad
        trained = train_published(
            folder, name, choices, self.profile, phase, self.mask, training, validation, processes=ONE
        )
        self.kept.keep(folder, trained, validation)
        drawn = choices.steps * choices.batch
        return self.outcome(name, size, choices.steps, folder, trained, validation, unseen, preparing, drawn)

    def begun(self, folder: Path, options: dict[str, Any]) -> Path:
        """The folder of a run that was begun with these options; finished, if it was kept."""
        folder.mkdir(parents=True, exist_ok=True)
        if self.kept.bring(folder, options):
            click.echo(f"trained before: {folder.relative_to(self.out.parent)}", err=True)
        begin(folder, options)
        return folder

    def decoded(self, module: DecoderTraining[Any], pages: Dataset[Page], scale: float) -> NDArray[np.float32]:
        """p of all data symbols of pages, piston off and calibrated, [2, symbols]."""
        found = zip(*decode_pages(module, pages), strict=True)
        return np.concatenate([without_piston(p * scale, t, self.mask)[:, ~self.mask] for p, t in found], axis=1)

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
        drawn: float,
    ) -> Outcome:
        """Figures of the held-out pages, kappa calibrated on the validation pages."""
        module: DecoderTraining[Any] = trained.module
        scale = best_kappa_scale(module, validation, self.mask)
        px, py = self.decoded(module, unseen, scale)
        truth = [self.recording.symbols(page) for page in self.unseen]
        symbols = np.concatenate([page[~self.mask] for page in truth if page is not None])
        figures = measure(np.arctan2(py, px), np.hypot(px, py), symbols, LEVELS)
        by_symbol = np.full(self.profile.page_shape, np.nan)
        rates = achievable_rate(np.arctan2(py, px), np.hypot(px, py), symbols, LEVELS)
        by_symbol[~self.mask] = rates.reshape(len(truth), -1).mean(axis=0)
        np.save(folder / MAP, by_symbol)
        zones = symbols_by_walls(self.profile, self.fitted)
        groups = {name: by_symbol[~self.mask & there] for name, there in zones.items()}
        validated = trained.curves.get("val_air", [])
        data = int((~self.mask).sum())
        return Outcome(
            kappa_scale=scale,
            validation_curve=validated,
            training_curve=trained.curves.get("train_air", []),
            run=str(folder.relative_to(self.out.parent)),
            method=name,
            size=size,
            steps=steps,
            air=figures.air_bits_per_symbol,
            own_mi=figures.own_mi_bits_per_symbol,
            symbol_error_rate=figures.symbol_error_rate,
            own_mi_unscaled=float(own_information(np.arctan2(py, px), np.hypot(px, py) / scale, LEVELS).mean()),
            page_kB=page_kilobytes(figures.air_bits_per_symbol, data),
            own_mi_kB=page_kilobytes(figures.own_mi_bits_per_symbol, data),
            by_walls={name: float(air.mean()) if air.size else float("nan") for name, air in groups.items()},
            validation_air=trained.validation_air,
            gained_in_last_fifth=gained_at_the_end(validated, steps),
            preparing_seconds=preparing,
            training_seconds=trained.seconds,
            pages_per_second=drawn / trained.seconds,
        )
