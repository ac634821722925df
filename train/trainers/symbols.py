"""The way of training decoders at symbol pitch: features of recorded and synthetic pages, then the network."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from torch import Tensor, nn

from lightpage.calibration.known_pages import known_pages
from lightpage.device.profile import Profile
from lightpage.errors import InvalidInputError
from lightpage.progress import note
from lightpage.train.data.feature_store import FeatureStore, fill
from lightpage.train.data.known_light import Explained, explained
from lightpage.train.data.patches import training_pages
from lightpage.train.data.synthetic import MOST_NOISE, SyntheticPages, model_match
from lightpage.train.data.training_inputs import Trained, TrainingInputs
from lightpage.train.fitting.concentration_scale import best_kappa_scale
from lightpage.train.fitting.fit import fit_network
from lightpage.train.fitting.fitted import Fitted
from lightpage.train.fitting.modules import SymbolTraining
from lightpage.train.models.decoder import WAVE, SymbolDecoder
from lightpage.train.models.hyperparameters import Hyperparameters
from lightpage.train.runs import load_decoder, load_run
from lightpage.train.trainers.refinement import Refined, RefinementPages, fit_prediction, fit_refinements
from lightpage.waves.grid import symbol_samples

_SYNTHETIC_SYMBOLS = 470_000
"""Symbols of all synthetic pages together, unless told otherwise: 96 pages of the bench device."""
_SYNTHETIC_PAGES = 12, 96
"""Fewest and most: few large ones would show few drifted states, and more small ones teach no more."""
MATCHED_PAGES = 2
"""Recorded pages that the wave model is compared with: each has thousands of symbols."""


def default_synthetic_pages(profile: Profile) -> int:
    """Synthetic pages that are made unless told otherwise."""
    return int(np.clip(round(_SYNTHETIC_SYMBOLS / np.prod(profile.page_shape)), *_SYNTHETIC_PAGES))


@dataclass(frozen=True)
class SymbolTrainer:
    """Trains the network at symbol pitch.

    Attributes:
        localizer: name out of `LOCALIZERS`.
        choices: the run's.
        synthetic_pages: pages of the drifted device to train on beside the recorded ones.
        start: finished run whose weights are begun with.
    """

    localizer: str
    choices: Hyperparameters
    synthetic_pages: int
    start: Path | None

    def options(self) -> dict[str, object]:
        """Everything that a run must go on with, by the names of the command line."""
        return {
            "--localizer": self.localizer,
            "--synthetic-pages": self.synthetic_pages,
            "--start": None if self.start is None else str(self.start.resolve()),
            **{f"--{name.replace('_', '-')}": value for name, value in asdict(self.choices).items()},
        }

    def train(self, inputs: TrainingInputs) -> Trained:
        """Train, or go on with, the run; raises KeyboardInterrupt after Ctrl-C, with nothing lost.

        Raises:
            InvalidInputError: a start that is no finished run, or of another size.
        """
        before = None if self.start is None else self._before(inputs.profile)
        known = [*inputs.training, *inputs.validation]
        features = inputs.out / "features"
        preparing = fill(
            features,
            f"{inputs.key} {self.localizer} {self.choices.first_pass}",
            len(known),
            lambda first, shift: inputs.extractor.pages(inputs.recording, known[first:], shift),
            "recorded pages",
        )
        count = len(inputs.training)
        known_light = self._explained(inputs)
        stores = [FeatureStore(features, range(count)), *map(FeatureStore, self._synthetic(inputs, known_light))]
        training = training_pages(stores, inputs.pilot_mask, self.choices, inputs.levels)
        validation = FeatureStore(features, range(count, len(known)))
        fitted = fit_network(
            inputs.out,
            self.choices,
            inputs.pilot_mask,
            inputs.levels,
            training,
            validation,
            start=None if before is None else before.network,
            processes=inputs.processes,
        )
        weights = {f"network.{name}": value for name, value in fitted.module.network.state_dict().items()}
        seconds, last = preparing + fitted.seconds, fitted
        if self.choices.refinements:
            refined = self._refined(
                inputs,
                RefinementPages(inputs.recording, known, count, len(inputs.validation), features),
                fitted,
                known_light,
                () if before is None else before.refiners,
                weights,
            )
            seconds, last, validation = seconds + refined.seconds, refined.last, refined.validation
        return Trained(
            weights=weights,
            validation_air=last.validation_air,
            kappa_scale=best_kappa_scale(last.module, validation, inputs.pilot_mask),
            seconds=seconds,
            synthetic_pages=sum(map(len, stores)) - count,
        )

    def _refined(
        self,
        inputs: TrainingInputs,
        pages: RefinementPages,
        first: Fitted[SymbolTraining],
        known_light: list[Explained],
        starts: Iterable[nn.Module],
        weights: dict[str, Tensor],
    ) -> Refined:
        """Trained refinements, which add what they have learnt to the weights."""
        prediction = fit_prediction(inputs.extractor, known_light)
        refined = fit_refinements(
            inputs.out,
            self.choices,
            pages,
            inputs.extractor,
            prediction,
            first,
            f"{inputs.key} {self.localizer} {self.choices.first_pass}",
            starts,
            inputs.processes,
        )
        for name, module in {
            "prediction": prediction,
            "refiners": nn.ModuleList(one.module.network for one in refined.trained),
        }.items():
            weights |= {f"{name}.{key}": value for key, value in module.state_dict().items()}
        return refined

    def check_start(self, profile: Profile) -> None:
        """Check that the run to start from, if any, has networks of this size.

        Raises:
            InvalidInputError: see `train`.
        """
        if self.start is not None:
            self._before(profile)

    def _before(self, profile: Profile) -> SymbolDecoder:
        """The decoder whose weights are begun with: those of its first pass, and of as many refinements as it has."""
        assert self.start is not None
        run = load_run(self.start)
        size = (run.localizer, run.profile.page_shape, *_size(run.hyperparameters, run.profile))
        expected = (self.localizer, profile.page_shape, *_size(self.choices, profile))
        if size != expected:
            raise InvalidInputError(
                f"--start {self.start}: localizer, page, channels, blocks, depth, samples", size, f"{expected}"
            )
        return load_decoder(self.start, run)

    def _explained(self, inputs: TrainingInputs) -> list[Explained]:
        """Recorded pages against the wave model; none where nothing is made of it."""
        if not (self.synthetic_pages or self.choices.refinements):
            return []
        pages = known_pages(inputs.recording, inputs.profile, inputs.training[:MATCHED_PAGES])
        return explained(inputs.extractor, pages)

    def _synthetic(self, inputs: TrainingInputs, known: list[Explained]) -> list[Path]:
        """Folder with the features of synthetic pages; none where the wave model is not like the device."""
        if self.synthetic_pages == 0:
            return []
        profile, seed = inputs.profile, self.choices.seed
        like = model_match(known)
        if like.noise > MOST_NOISE:
            note(f"no synthetic pages: the wave model leaves {like.noise:.0%} of the light unexplained")
            return []
        note(f"the wave model leaves {like.noise:.1%} of the recorded light unexplained")
        folder = inputs.out / "synthetic"
        reader = None if self.localizer == WAVE else self.choices.coherent_localizer(profile)
        pages = SyntheticPages(inputs.extractor.device, like, reader, seed, inputs.extractor.grid)
        key = f"{self.localizer} {self.choices.first_pass} {seed} "
        key += f"{profile.to_toml()} {inputs.calibration.to_toml()} {like.noise:.6f} "
        key += f"{np.round(like.illumination, 6).tolist()}"
        fill(folder, key, self.synthetic_pages, lambda first, shift: pages.pages(first), "synthetic pages")
        return [folder]


def _size(choices: object, profile: Profile) -> tuple[object, ...]:
    samples = getattr(choices, "samples", 0) or symbol_samples(profile)
    return (*(getattr(choices, name, None) for name in ("channels", "blocks", "depth")), samples)
