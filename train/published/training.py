"""Training of the published decoders as published (supplement S6), on frames as the cameras gave them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.data import Dataset

from lightpage.page.levels import Levels
from lightpage.page.modulation import NOMINAL, Modulation
from lightpage.page.symbols import symbol_phases
from lightpage.recording.reader import Recording
from lightpage.train.data.features import PageState
from lightpage.train.data.pages import Page
from lightpage.train.fitting.modules import DecoderTraining
from lightpage.train.published.decoder import PARAXIAL, PublishedDecoder
from lightpage.train.published.localizers import RayLocalizer

AUTHORS, PROFILE = "authors", "profile"
WARM_UP = 0.02
"""Share of the steps over which learning rates rise."""
DECAYS = (0.8, 0.9)
"""Shares of the steps at which the decoder's learning rate falls."""
NOT_ASKED = -1
"""Class of a symbol that is not asked for."""
LARGEST_GRADIENT = 1.0
"""Norm of the decoder's gradient beyond which it is scaled down."""


@dataclass(frozen=True)
class PublishedChoices:
    """Hyperparameters of a published decoder; the defaults are its authors' for 4x4 symbols.

    Attributes:
        channels: channels of the U-Net, at sample pitch and below.
        steps: optimiser steps: 50 epochs of 450 pages, two at a time.
        batch: pages a step.
        decoder_rate, affine_rate, angle_rate: learning rates of U-Net, registration and pipe angle (radians).
        held_share: share of the steps over which registration and angle stay as they begin, not the authors'.
        start: where registrations begin: `AUTHORS`, or as the profile says, `PROFILE`.
        begins_rad: angle at the beginning, beyond the profile's, not the authors'.
        page_moves: whether rays train an affine of the page against the pipe too, not the authors'.
        decay: factor on the decoder's learning rate at each of `DECAYS`.
        lenses: name out of `lightpage.train.published.decoder.LENS_CHOICES`.
        seed: seed of initial weights and batches.
        precision: see `lightpage.train.fitting.precision`.
        classes: levels that the decoder tells apart by cross-entropy; 0 for the von Mises likelihood.
    """

    channels: tuple[int, int] = (32, 64)
    steps: int = 11_250
    batch: int = 2
    decoder_rate: float = 1e-3
    affine_rate: float = 2e-4
    angle_rate: float = 1e-4
    held_share: float = 0.0
    start: str = AUTHORS
    begins_rad: float = 0.0
    page_moves: bool = False
    decay: float = 0.5
    lenses: str = PARAXIAL
    seed: int = 0
    precision: str = "auto"
    classes: int = 0

    def kept(self) -> dict[str, Any]:
        """Return the choices as a run keeps them: those that are not the authors' only where they say something.

        Runs that were begun before these were there are then gone on with.
        """
        usual = {name: getattr(PublishedChoices, name) for name in ("held_share", "start", "begins_rad", "page_moves")}
        chosen = asdict(self) | {"channels": list(self.channels)}
        return {name: value for name, value in chosen.items() if name not in usual or value != usual[name]}


class FramePages(Dataset[Page]):
    """Recorded pages as a published decoder takes them: frames [2, H, W], state [3], true phases [ny, nx].

    A state is the image's shift (x, y) in pixels and the piston in radians.

    Args:
        recording: recording with symbols; stays open.
        pages: numbers of the pages to show.
        states: states of those pages.
        modulation: light that the modulator makes of its levels.
    """

    def __init__(
        self,
        recording: Recording,
        pages: Sequence[int],
        states: Sequence[PageState],
        modulation: Modulation = NOMINAL,
    ) -> None:
        self.recording, self._pages, self.states = recording, pages, states
        self.references = recording.references()
        self.levels = modulation.page_levels(recording.levels)

    def __len__(self) -> int:
        """Pages."""
        return len(self._pages)

    def __getitem__(self, index: int) -> Page:
        """Return a page: frames, state and true phases."""
        page, state = self._pages[index], self.states[index]
        pair, symbols = self.recording.frames(page), self.recording.symbols(page)
        assert symbols is not None
        phases = symbol_phases(symbols, self.levels).astype(np.float32)
        return (
            torch.from_numpy(np.stack([pair.in_phase, pair.quadrature]).astype(np.float32)),
            torch.tensor([*state.shift_px, state.piston_rad], dtype=torch.float32),
            torch.from_numpy(phases),
        )


class DataPages(Dataset[Page]):
    """Pages whose pilots are not asked for: their phases are NaN.

    Args:
        pages: a list of them, all their phases known.
        pilot_mask: bool [ny, nx].
    """

    def __init__(self, pages: Dataset[Page], pilot_mask: NDArray[np.bool_]) -> None:
        self._pages, self._pilots = pages, torch.from_numpy(pilot_mask)

    def __len__(self) -> int:
        """Pages."""
        return len(self._pages)  # type: ignore[arg-type]  # it has a length

    def __getitem__(self, index: int) -> Page:
        """Return a page, with NaN for the phases of its pilots."""
        *shown, phases = self._pages[index]
        return *shown, torch.where(self._pilots.to(phases.device), torch.nan, phases)


class PublishedTraining(DecoderTraining[PublishedDecoder]):
    """A published decoder, with Adam at three learning rates.

    Frames without a known piston cannot show phases, so each page's piston is added to the phases that it is asked for,
    and its shift to where it is looked at. Its authors' device stood still.

    Args:
        network, pilot_mask, levels: see `DecoderTraining`.
        choices: the run's.
    """

    def __init__(
        self,
        network: PublishedDecoder,
        choices: PublishedChoices,
        pilot_mask: NDArray[np.bool_],
        levels: int | Levels,
    ) -> None:
        super().__init__(network, pilot_mask, levels)
        self.choices = choices

    def forward(self, *page: Tensor) -> Tensor:
        """Frames [N, 2, H, W] and states [N, 3] to p [N, 2, ny, nx]."""
        frames, state = page
        return torch.as_tensor(self.network(frames, state[:, :2]))

    def training_step(self, batch: Page, index: int) -> Tensor:
        """Loss of the phases as the page's piston turns them."""
        frames, state, phases = batch
        localizer = self.network.localizer
        if isinstance(localizer, RayLocalizer):
            self.log("angle_deg", math.degrees(localizer.angle.detach().item()))
        asked, scores = phases + state[:, 2, None, None], self.network.scores(frames, state[:, :2])
        if not self.choices.classes:
            return self.loss(scores, asked)
        loss = functional.cross_entropy(
            scores.float(), nearest_class(asked, self.choices.classes), ignore_index=NOT_ASKED
        )
        self.log("train_air", rate_of_classes(loss.detach(), self.choices.classes))
        return loss

    def rate(self, batch: Page) -> float:
        """AIR of held-out pages, bits per data symbol: of posteriors over classes, piston known, if it has them."""
        if not self.choices.classes:
            return super().rate(batch)
        frames, state, phases = batch
        scores = self.network.scores(frames, state[:, :2]).float().cpu()
        truth = nearest_class(phases + state[:, 2, None, None], self.choices.classes).cpu()
        data = torch.from_numpy(~self.pilot_mask)
        nats = functional.cross_entropy(scores[:, :, data], truth[:, data])
        return float(rate_of_classes(nats, self.choices.classes))

    def configure_optimizers(self) -> Any:
        """Adam; all rates warm up, those of the geometry after it was held; the decoder's falls towards the end."""
        choices, localizer = self.choices, self.network.localizer
        angle = [localizer.angle] if isinstance(localizer, RayLocalizer) else []
        page = localizer.page if isinstance(localizer, RayLocalizer) else None
        affine = [*localizer.registration.parameters(), *(page.parameters() if page else ())]
        apart = {id(parameter) for parameter in (*angle, *affine)}
        decoder = [parameter for parameter in self.network.parameters() if id(parameter) not in apart]
        held = choices.held_share * choices.steps
        groups: list[tuple[list[nn.Parameter], float, float, float]] = [
            (decoder, choices.decoder_rate, choices.decay, 0.0),
            (affine, choices.affine_rate, 1.0, held),
            (angle, choices.angle_rate, 1.0, held),
        ]
        groups = [group for group in groups if group[0]]
        optimizer = torch.optim.Adam([{"params": parameters, "lr": rate} for parameters, rate, *_ in groups])

        def course(decay: float, first: float) -> Any:
            warm_up = max(1.0, WARM_UP * choices.steps)
            falls = [share * choices.steps for share in DECAYS]
            return lambda step: (
                min(1.0, max(0.0, step + 1 - first) / warm_up) * decay ** sum(step >= at for at in falls)
            )

        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, [course(*times) for _, _, *times in groups])
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def configure_gradient_clipping(self, *_: Any, **__: Any) -> None:
        """The U-Net's gradient, as one vector."""
        nn.utils.clip_grad_norm_(self.network.unet.parameters(), LARGEST_GRADIENT)


def rate_of_classes(nats: Tensor, classes: int) -> Tensor:
    """Bits that are known of a symbol of so many levels, by the cross-entropy that is left of it."""
    return math.log2(classes) - nats / math.log(2)


def nearest_class(phases: Tensor, classes: int) -> Tensor:
    """The level nearest to each phase, int64, `NOT_ASKED` for NaN.

    Half a level is lost where a piston turns the phases between levels.
    """
    nearest = torch.round(torch.nan_to_num(phases) * (classes / (2 * math.pi))).long() % classes
    return torch.where(torch.isfinite(phases), nearest, NOT_ASKED)
