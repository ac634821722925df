"""Pages, calibration and features, which all methods of a comparison share."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np
from numpy.typing import NDArray

from analysis.comparison.data_set import CALIBRATED, LEVELS, calibrated
from analysis.comparison.methods.oracle import Oracle
from analysis.comparison.weight_store import CALIBRATION, WeightStore
from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.document import Calibration
from lightpage.device.profile import Profile
from lightpage.device.state import Device
from lightpage.page.levels import Levels
from lightpage.page.symbols import pilot_mask
from lightpage.recording.reader import Recording
from lightpage.simulator.true_optics import perfectly_calibrated
from lightpage.train.data.feature_store import FeatureStore
from lightpage.train.data.features import FeatureExtractor, PageFeatures
from lightpage.train.models.hyperparameters import Hyperparameters
from lightpage.train.models.presets import FAST, PRESETS
from lightpage.train.runs import begin

ORACLE = "oracle"
HELD_OUT_SHARE = 0.05


@dataclass(frozen=True)
class Bench:
    """Data that all methods share.

    Attributes:
        recording: open.
        profile, device: nominal and true.
        fitted: the calibration.
        out: folder of everything.
        training, validation, unseen: page numbers.
        levels: numbers of levels of further recordings, on which confidences are judged.
        seed: seed of the recording; the methods' seeds follow from it.
        kept: store of this data set.
        reflections: rounds to the field, of methods that are not `fast`; see `Hyperparameters`.
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
    reflections: int = 0

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
        """Pages that are not calibrated on, in order."""
        return [*self.training, *self.validation, *self.unseen]

    def calibrated_device(self, method: str = "") -> CalibratedDevice:
        """The device as a method knows it: fitted, or true."""
        references = self.recording.references()
        if method == ORACLE:
            return perfectly_calibrated(self.profile, self.device, references)
        return self.fitted.device(self.profile, references)

    def levels_of(self, method: str) -> Levels:
        """Levels of the pages, as the modulator of the device that a method knows shows them."""
        return self.calibrated_device(method).modulation.page_levels(LEVELS)

    def extractor(self, method: str) -> FeatureExtractor:
        """Features of the calibrated device; of the true one for an oracle's further pass, signal power left in."""
        localizer = "coherent" if method in (ORACLE, FAST) else method
        choices = PRESETS[FAST].choices if method == FAST else Hyperparameters(reflections=self.reflections)
        return FeatureExtractor(self.calibrated_device(method), localizer, choices)

    def key(self, name: str) -> str:
        """Return what the features of a method depend on, beside the recording."""
        if name == ORACLE:
            return ""
        reflections = f"{self.reflections} reflections" if self.reflections else ""
        return self.fitted.to_toml() + (PRESETS[FAST].choices.first_pass if name == FAST else reflections)

    def features_of(
        self, name: str, recording: Recording, pages: Sequence[int], start: int, shift: tuple[float, float]
    ) -> Iterator[PageFeatures]:
        """First passes of a method at pages from one on, in their order; the image had moved by `shift` before."""
        if name == ORACLE:
            return Oracle(recording, self.profile, self.device).pages(pages[start:], shift)
        return self.extractor(name).pages(recording, pages[start:], shift)

    def held_out(self, features: Path) -> tuple[FeatureStore, FeatureStore]:
        """Features of the validation pages, and of those for the figures."""
        first, last, end = len(self.training), len(self.training) + len(self.validation), len(self.pages)
        return FeatureStore(features, range(first, last)), FeatureStore(features, range(last, end))

    def begun(self, folder: Path, options: dict[str, Any]) -> Path:
        """The folder of a run that was begun with these options; finished, if it was kept."""
        folder.mkdir(parents=True, exist_ok=True)
        if self.kept.bring(folder, options):
            click.echo(f"trained before: {folder.relative_to(self.out.parent)}", err=True)
        begin(folder, options)
        return folder
