"""The way of training the published decoders: raw frames, with each page's piston and shift taken off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from lightning.pytorch.callbacks import Callback
from numpy.typing import NDArray
from torch.utils.data import DataLoader

from lightpage.device.lenses import lens_of
from lightpage.device.profile import Profile
from lightpage.recording.frame_pair import FramePair
from lightpage.train.data.training_inputs import Trained, TrainingInputs
from lightpage.train.fitting.concentration_scale import best_kappa_scale
from lightpage.train.fitting.fit import fit, seed_stretch
from lightpage.train.fitting.fitted import Fitted
from lightpage.train.processes import AS_IT_IS, Processes
from lightpage.train.published.decoder import PARAXIAL, PublishedDecoder, make_localizer
from lightpage.train.published.held_pages import HeldPages
from lightpage.train.published.localizers import RayLocalizer
from lightpage.train.published.states import page_states
from lightpage.train.published.training import PROFILE, DataPages, FramePages, PublishedChoices, PublishedTraining
from lightpage.train.published.unet import samples_for

EPOCHS = {4: 50, 8: 30, 16: 15}
"""Passes over the training pages, by samples per symbol and axis (table 1)."""

_OPTIONS = {name: f"--{name}" for name in ("channels", "steps", "batch", "lenses", "seed", "precision")}
_OPTIONS["decoder_rate"] = "--learning-rate"
"""Choices that a run keeps under the name of their option."""


def published_choices(localizer: str, profile: Profile, pages: int, batch: int | None = None) -> PublishedChoices:
    """The authors' hyperparameters for a device's symbols and so many training pages; `batch` in place of two.

    As with them, rays go through thick lenses where the device has real ones, if there is a prescription of those.
    """
    samples = samples_for(profile.page.symbol_size_px)
    batch = PublishedChoices.batch if batch is None else batch
    steps = EPOCHS[samples] * -(-pages // batch)
    decay = PublishedChoices.decay if samples == 4 else 1.0
    lens = lens_of(profile) if localizer == "ray" else None
    return PublishedChoices(steps=steps, batch=batch, decay=decay, lenses=lens.name if lens else PARAXIAL)


@dataclass(frozen=True)
class PublishedTrainer:
    """Trains a published decoder.

    Attributes:
        localizer: name out of `lightpage.train.published.localizers.NAMES`.
        choices: the run's.
    """

    localizer: str
    choices: PublishedChoices

    def options(self) -> dict[str, object]:
        """Everything that a run must go on with, under the names of the command line where it has one."""
        chosen = {_OPTIONS.get(name, name): value for name, value in self.choices.kept().items()}
        return {"--localizer": self.localizer, **chosen, "--channels": self.choices.channels[0]}

    def train(self, inputs: TrainingInputs) -> Trained:
        """Train, or go on with, the run; raises KeyboardInterrupt after Ctrl-C, with nothing lost."""
        known = [*inputs.training, *inputs.validation]
        path = inputs.out / "states.json"
        states, preparing = page_states(path, inputs.key, inputs.recording, inputs.extractor, known)
        count = len(inputs.training)
        modulation = inputs.calibration.modulator
        training = FramePages(inputs.recording, known[:count], states[:count], modulation)
        validation = FramePages(inputs.recording, known[count:], states[count:], modulation)
        fitted = train_published(
            inputs.out,
            self.localizer,
            self.choices,
            inputs.profile,
            inputs.calibration.turn_rad,
            inputs.pilot_mask,
            training,
            validation,
            processes=inputs.processes,
        )
        return Trained(
            weights=fitted.module.network.state_dict(),
            validation_air=fitted.validation_air,
            kappa_scale=best_kappa_scale(fitted.module, validation, inputs.pilot_mask),
            seconds=preparing + fitted.seconds,
        )


def train_published(
    run: Path,
    localizer: str,
    choices: PublishedChoices,
    profile: Profile,
    quadrature_phase: float,
    mask: NDArray[np.bool_],
    training: FramePages | HeldPages,
    validation: FramePages | HeldPages,
    *,
    callbacks: Sequence[Callback] = (),
    processes: Processes = AS_IT_IS,
) -> Fitted[PublishedTraining]:
    """Train a published decoder from its first weights, or go on with it.

    Args:
        run: folder.
        localizer, choices, profile, quadrature_phase: see `published_decoder`.
        mask: pilots, bool [ny, nx], which are not learnt from.
        training, validation: pages of one device.
        callbacks, processes: see `lightpage.train.fitting.fit.fit`.
    """
    seed_stretch(run, choices.seed)
    decoder = published_decoder(localizer, choices, profile, training.references, quadrature_phase)
    module = PublishedTraining(decoder, choices, mask, training.levels)
    return fit(
        run,
        module,
        DataLoader(DataPages(training, mask), batch_size=choices.batch, shuffle=True),
        validation,
        steps=choices.steps,
        precision=choices.precision,
        callbacks=callbacks,
        processes=processes,
    )


def published_decoder(
    localizer: str, choices: PublishedChoices, profile: Profile, references: FramePair, quadrature_phase: float
) -> PublishedDecoder:
    """A published decoder with its first weights.

    Args:
        localizer: name out of `lightpage.train.published.localizers.NAMES`.
        choices: size and lenses of the decoder.
        profile: the nominal device.
        references: reference-only frames.
        quadrature_phase: angle between the homodyne arms, whose sign the mode localizer must know.

    Raises:
        InvalidInputError: no such localizer or lens.
    """
    sign = 1 if np.sin(quadrature_phase) > 0 else -1
    samples = samples_for(profile.page.symbol_size_px)
    chosen = make_localizer(localizer, profile, samples, choices.lenses, sign, page_moves=choices.page_moves)
    if isinstance(chosen, RayLocalizer):
        chosen.angle.data += choices.begins_rad
    if choices.start == PROFILE:
        rows, columns = profile.frame_shape
        pixel = profile.image_pixel_m
        chosen.registration.begin((profile.page_width_m / (columns * pixel), profile.page_height_m / (rows * pixel)))
    return PublishedDecoder(profile, references, chosen, choices.channels, choices.classes)
