"""The way of training the published decoders: raw frames, with each page's piston and shift taken off."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from optics.profile import Profile
from optics.recording import FramePair
from train.fitting import best_kappa_scale, seed_stretch
from train.material import Material, Trained
from train.published.decoder import PublishedDecoder, make_localizer
from train.published.states import page_states
from train.published.training import FramePages, PublishedChoices, PublishedTraining, fit_published
from train.published.unet import samples_for

EPOCHS = {4: 50, 8: 30, 16: 15}
"""Passes over the training pages, by samples per symbol and axis (table 1)."""


def published_choices(profile: Profile, pages: int, batch: int | None = None) -> PublishedChoices:
    """The authors' hyperparameters for a device's symbols and so many training pages; `batch` in place of two."""
    samples = samples_for(profile.page.symbol_size_px)
    batch = PublishedChoices.batch if batch is None else batch
    steps = EPOCHS[samples] * -(-pages // batch)
    return PublishedChoices(steps=steps, batch=batch, decay=PublishedChoices.decay if samples == 4 else 1.0)


@dataclass(frozen=True)
class PublishedRecipe:
    """Trains a published decoder.

    Attributes:
        localizer: of `train.published.localizers.NAMES`.
        choices: the run's.
    """

    localizer: str
    choices: PublishedChoices

    def options(self) -> dict[str, object]:
        """Everything that a run must go on with, by the names of the command line."""
        chosen = asdict(self.choices) | {"channels": list(self.choices.channels)}
        return {"--localizer": self.localizer, **{f"--{name.replace('_', '-')}": v for name, v in chosen.items()}}

    def train(self, material: Material) -> Trained:
        """Train, or go on with, the run; raises KeyboardInterrupt after Ctrl-C, with nothing lost."""
        known = [*material.training, *material.validation]
        path = material.out / "states.json"
        states, preparing = page_states(path, material.key, material.recording, material.extractor, known)
        count = len(material.training)
        training = FramePages(material.recording, known[:count], states[:count])
        validation = FramePages(material.recording, known[count:], states[count:])
        seed_stretch(material.out, self.choices.seed)
        decoder = published_decoder(
            self.localizer, self.choices, material.profile, material.references, material.calibration.turn_rad
        )
        module = PublishedTraining(decoder, self.choices, material.pilot_mask, material.recording.levels)
        fitted = fit_published(material.out, module, training, validation, devices=material.devices)
        return Trained(
            weights=fitted.module.network.state_dict(),
            validation_air=fitted.validation_air,
            kappa_scale=best_kappa_scale(fitted.module, validation, material.pilot_mask),
            seconds=preparing + fitted.seconds,
        )


def published_decoder(
    localizer: str, choices: PublishedChoices, profile: Profile, references: FramePair, turn: float
) -> PublishedDecoder:
    """A published decoder with its first weights.

    Args:
        localizer: of `train.published.localizers.NAMES`.
        choices: its size and lenses.
        profile: the nominal device.
        references: reference-only frames.
        turn: angle between the homodyne arms, whose sign the mode localizer must know.

    Raises:
        InvalidInputError: no such localizer or lens.
    """
    sign = 1 if np.sin(turn) > 0 else -1
    samples = samples_for(profile.page.symbol_size_px)
    chosen = make_localizer(localizer, profile, samples, choices.lenses, sign)
    return PublishedDecoder(profile, references, chosen, choices.channels, choices.classes)
