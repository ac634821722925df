"""Decoders as Lightning trains them."""

from __future__ import annotations

import math
from statistics import fmean
from typing import Any, Generic, TypeVar

import lightning as L
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from lightpage.page.levels import Levels
from lightpage.train.data.pages import Page
from lightpage.train.fitting.loss import training_rate, von_mises_nll
from lightpage.train.fitting.validation import held_out_air
from lightpage.train.models.hyperparameters import Hyperparameters
from lightpage.train.models.network import Refiner, SymbolUNet
from lightpage.train.models.parts import turned

AVERAGED_SHARE = 0.05
"""Share of a run's steps over which its weights are averaged, exponentially: what is validated, kept and exported."""

SymbolNetwork = SymbolUNet | Refiner

N = TypeVar("N", bound=nn.Module)


class DecoderTraining(L.LightningModule, Generic[N]):
    """A decoder under the von Mises loss, validated by AIR.

    Pages to train on have phases that are NaN where nothing is asked; pages to validate with have all of theirs.

    Args:
        network: pages without their phases to p [N, 2, ny, nx].
        pilot_mask: bool [ny, nx]; pilots are no data: no figure counts them.
        levels: levels of the pages, whose number bounds their AIR.
    """

    def __init__(self, network: N, pilot_mask: NDArray[np.bool_], levels: int | Levels) -> None:
        super().__init__()
        self.network = network
        self.pilot_mask, self.levels = pilot_mask, Levels.of(levels)
        self._rates: list[float] = []

    def forward(self, *page: Tensor) -> Tensor:
        """A batch of pages to p [N, 2, ny, nx]."""
        return torch.as_tensor(self.network(*page))

    def loss(self, p: Tensor, phases: Tensor) -> Tensor:
        """Mean over the symbols that are asked for, logged."""
        asked = torch.isfinite(phases)
        loss = von_mises_nll(p, torch.where(asked, phases, 0.0))[asked].mean()
        self.log("train_nll", loss, prog_bar=True)
        rate = training_rate(p.movedim(1, 0)[:, asked], phases[asked], self.levels.count)
        self.log("train_air", rate, prog_bar=True)
        return loss

    def rate(self, batch: Page) -> float:
        """AIR of held-out pages, bits per data symbol, piston taken off by the pilots as the runtime does it."""
        p, phases = self(*batch[:-1]).float().cpu().numpy(), batch[-1].cpu().numpy()
        return held_out_air(p, phases, self.pilot_mask, self.levels)

    def validation_step(self, batch: Page, index: int) -> None:
        """Judge a held-out page."""
        self._rates.append(self.rate(batch))

    def on_validation_epoch_end(self) -> None:
        """AIR of the held-out pages."""
        air = fmean(self._rates)
        self._rates.clear()
        # each of several processes has seen as many pages as the others
        self.log("val_air", air, prog_bar=True, sync_dist=True)


class SymbolTraining(DecoderTraining[SymbolNetwork]):
    """A network at symbol pitch, with exact rotation augmentation.

    Its pages are light [N, 2 C, ny, nx], exit centroids [N, 2, ny, nx], for a `Refiner` the estimate so far
    [N, 2, ny, nx], and true phases [N, ny, nx].

    Args:
        network, pilot_mask, levels: see `DecoderTraining`.
        hyperparameters: the run's choices.
    """

    def __init__(
        self,
        network: SymbolNetwork,
        hyperparameters: Hyperparameters,
        pilot_mask: NDArray[np.bool_],
        levels: int | Levels,
    ) -> None:
        super().__init__(network, pilot_mask, levels)
        self.choices = hyperparameters

    def forward(self, *page: Tensor) -> Tensor:
        """Light, exit centroids and the estimate so far to p [N, 2, ny, nx]."""
        light, *others = page
        return torch.as_tensor(self.network(light.float(), *others))

    def training_step(self, batch: Page, index: int) -> Tensor:
        """Loss of pages whose field and symbols were turned by one random angle each: piston is no information."""
        light, positions, *estimate, phases = batch
        rotation = 2 * math.pi * torch.rand(len(light), 1, 1, device=light.device)
        shown = [_turned(part, rotation) for part in (light.float(), *estimate)]
        return self.loss(self(shown[0], positions, *shown[1:]), phases + rotation)

    def configure_optimizers(self) -> Any:
        """AdamW under a one-cycle schedule."""
        optimizer = torch.optim.AdamW(
            self.parameters(), lr=self.choices.learning_rate, weight_decay=self.choices.weight_decay
        )
        steps = self.choices.steps
        warm_up = min((steps + 1) / 2, max(0.1 * steps, 2)) / steps  # between one step and all, or it divides by zero
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimizer, self.choices.learning_rate, total_steps=steps, pct_start=warm_up
        )
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


def _turned(parts: Tensor, by: Tensor) -> Tensor:
    """Real parts and then imaginary parts [N, 2 C, ny, nx], turned by an angle [N, 1, 1] each."""
    return torch.cat(list(turned(torch.stack(parts.chunk(2, dim=1)), by[:, None])), dim=1)
