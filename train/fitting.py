"""Training of a decoder network with Lightning: data on disk, checkpoints, resume, validation by AIR."""

from __future__ import annotations

import logging
import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch
from lightning.pytorch.callbacks import Callback, EMAWeightAveraging, ModelCheckpoint, Timer
from lightning.pytorch.loggers import TensorBoardLogger
from numpy.typing import NDArray
from scipy import optimize
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, RandomSampler

from optics.measures import achievable_rate
from optics.pilots import Pilots, estimate_piston, remove_piston
from train.loss import von_mises_nll
from train.network import SymbolUNet

CHECKPOINTS = "checkpoints"
"""Folder of a run's checkpoints."""
LOOKS = 60
"""How often a run looks at its validation pages."""
AVERAGED_SHARE = 0.05
"""Share of a run's steps over which its weights are averaged, exponentially: what is validated, kept and exported."""


@dataclass(frozen=True)
class Hyperparameters:
    """Everything that a training run chooses.

    Attributes:
        channels, blocks, levels: size of the network, see `SymbolUNet`.
        steps: optimiser steps.
        batch: pages a step.
        learning_rate: peak of the one-cycle schedule.
        weight_decay: of AdamW.
        seed: of initial weights, batches and rotations.
        precision: Lightning's; bf16-mixed is fastest on CPUs with bf16 and on GPUs.
    """

    channels: int = 96
    blocks: int = 2
    levels: int = 0
    steps: int = 6000
    batch: int = 4
    learning_rate: float = 4e-3
    weight_decay: float = 1e-3
    seed: int = 0
    precision: str = "bf16-mixed"


Page = tuple[Tensor, Tensor, Tensor]
"""One page, or a batch of them: light [2 C, ny, nx], exit centroids [2, ny, nx], true phases [ny, nx]."""


class DecoderTraining(L.LightningModule):
    """A network under the von Mises loss, with exact rotation augmentation.

    Args:
        network: features to p.
        hyperparameters: the run's choices.
        pilot_mask: bool [ny, nx]; pilots are no data: neither loss nor figure counts them.
        levels: M of the pages, which bounds their AIR.
    """

    def __init__(
        self, network: SymbolUNet, hyperparameters: Hyperparameters, pilot_mask: NDArray[np.bool_], levels: int
    ) -> None:
        super().__init__()
        self.network = network
        self.choices = hyperparameters
        self.data: Tensor
        self.register_buffer("data", torch.from_numpy(~pilot_mask))
        self._pilot_mask, self._levels = pilot_mask, levels
        self._seen: list[tuple[Tensor, Tensor]] = []

    def forward(self, light: Tensor, positions: Tensor) -> Tensor:
        """Light [N, 2 C, ny, nx] and exit centroids [N, 2, ny, nx] to p [N, 2, ny, nx]."""
        return torch.as_tensor(self.network(light.float(), positions))

    def training_step(self, batch: Page, index: int) -> Tensor:
        """Loss of pages whose field and symbols were turned by one random angle each: piston is no information."""
        light, positions, phases = batch[0].float(), batch[1], batch[2]
        turn = 2 * math.pi * torch.rand(len(light), 1, 1, device=light.device)
        real, imaginary = light.chunk(2, dim=1)
        cos, sin = torch.cos(turn)[:, None], torch.sin(turn)[:, None]
        turned = torch.cat([real * cos - imaginary * sin, real * sin + imaginary * cos], dim=1)
        loss = von_mises_nll(self(turned, positions), phases + turn)[:, self.data].mean()
        self.log("train_nll", loss, prog_bar=True)
        self.log("train_air", air_of_nll(loss), prog_bar=True)
        return loss

    def validation_step(self, batch: Page, index: int) -> None:
        """Collect what the network says of held-out pages."""
        self._seen.append((self(batch[0], batch[1]).float().cpu(), batch[2].cpu()))

    def on_validation_epoch_end(self) -> None:
        """AIR of the held-out pages, piston taken off by the pilots as the runtime does it."""
        p = torch.cat([seen[0] for seen in self._seen]).numpy()
        phases = torch.cat([seen[1] for seen in self._seen]).numpy()
        self._seen.clear()
        # each of several processes has seen as many pages as the others
        air = held_out_air(p, phases, self._pilot_mask, self._levels)
        self.log("val_air", air, prog_bar=True, sync_dist=True)

    def configure_optimizers(self) -> Any:
        """AdamW under a one-cycle schedule."""
        optimizer = torch.optim.AdamW(
            self.parameters(), lr=self.choices.learning_rate, weight_decay=self.choices.weight_decay
        )
        warm_up = max(0.1, 2 / self.choices.steps)  # of less than two steps, the schedule divides by zero
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimizer, self.choices.learning_rate, total_steps=self.choices.steps, pct_start=warm_up
        )
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


def air_of_nll(nll: Tensor) -> Tensor:
    """AIR in bits per symbol of phases drawn evenly, from the mean negative log-likelihood in nats."""
    return math.log2(2 * math.pi) - nll.detach() / math.log(2)


def held_out_air(p: NDArray[np.float32], phases: NDArray[np.float32], mask: NDArray[np.bool_], levels: int) -> float:
    """AIR in bits per data symbol of decoded pages.

    Args:
        p: [pages, 2, ny, nx].
        phases: true phases [pages, ny, nx].
        mask: pilots, bool [ny, nx].
        levels: M of the pages.
    """
    rates = []
    for decoded, truth in zip(p, phases, strict=True):
        pilots = Pilots(mask, truth[mask].astype(np.float64))
        phase = remove_piston(np.arctan2(decoded[1], decoded[0]), estimate_piston(decoded, pilots).angle_rad)
        concentration = np.hypot(decoded[0], decoded[1])
        true_level = np.rint(truth * (levels / (2 * np.pi))).astype(np.int64) % levels
        air = achievable_rate(phase[~mask], concentration[~mask], true_level[~mask].astype(np.uint8), levels)
        rates.append(float(np.mean(air)))
    return float(np.mean(rates))


@dataclass(frozen=True)
class Fitted:
    """A trained module.

    Attributes:
        module: the best one, in float32.
        validation_air: its AIR on the validation pages, bits per data symbol.
        seconds: of training, all stretches of an interrupted run together.
    """

    module: DecoderTraining
    validation_air: float
    seconds: float


def fit_network(
    run: Path,
    hyperparameters: Hyperparameters,
    pilot_mask: NDArray[np.bool_],
    levels: int,
    training: Dataset[Page],
    validation: Dataset[Page],
    callbacks: list[Callback] | None = None,
    *,
    start: SymbolUNet | None = None,
    devices: int | str = "auto",
    progress: bool = True,
) -> Fitted:
    """Train, or go on with, the network of a run.

    On several devices Lightning runs the program once for each; all of them return the same.

    Raises KeyboardInterrupt after Ctrl-C, with the last checkpoint in place.

    Args:
        run: folder of the run; checkpoints and TensorBoard logs go there, and the last checkpoint is resumed from: the
            caller sees to it that it belongs to these pages and choices (`train.run.begin`).
        hyperparameters: the run's choices.
        pilot_mask: bool [ny, nx].
        levels: M of the pages.
        training, validation: pages.
        callbacks: further Lightning callbacks.
        start: network of the same size whose weights a new run begins with; random ones if left out.
        devices: how many GPUs, or processes where there is none; "auto" takes all GPUs, or one process.
        progress: whether to show a bar.
    """
    folder = run / CHECKPOINTS
    last = folder / "last.ckpt"
    reached = int(_checkpoint(last)["global_step"]) if last.exists() else 0
    # another stretch of the run draws other pages and turns
    L.seed_everything(hyperparameters.seed + reached, verbose=False)
    light_channels = training[0][0].shape[0]
    network = SymbolUNet(light_channels, hyperparameters.channels, hyperparameters.blocks, hyperparameters.levels)
    if start is not None:
        network.load_state_dict(start.state_dict())
    module = DecoderTraining(network, hyperparameters, pilot_mask, levels)
    best = ModelCheckpoint(folder, "best", monitor="val_air", mode="max")
    newest = ModelCheckpoint(folder, "last", save_on_train_epoch_end=True, enable_version_counter=False)
    timer = Timer()
    averaged = EMAWeightAveraging(use_buffers=False, decay=1 - 1 / max(1.0, AVERAGED_SHARE * hyperparameters.steps))
    draws = hyperparameters.batch * max(1, hyperparameters.steps // LOOKS)
    sampler = RandomSampler(training, replacement=True, num_samples=draws)  # type: ignore[arg-type]  # it has a length
    with _without_hints():
        trainer = L.Trainer(
            max_steps=hyperparameters.steps,
            precision=hyperparameters.precision,  # type: ignore[arg-type]
            logger=TensorBoardLogger(str(run), name="", version="tensorboard"),
            callbacks=[averaged, best, timer, newest, *(callbacks or [])],
            devices=devices,
            enable_progress_bar=progress,
            enable_model_summary=False,
            gradient_clip_val=1.0,
            num_sanity_val_steps=0,
            log_every_n_steps=10,
            default_root_dir=run,
        )
    try:
        with _without_hints():
            trainer.fit(
                module,
                DataLoader(training, batch_size=hyperparameters.batch, sampler=sampler),
                DataLoader(validation, batch_size=1),
                ckpt_path=last if last.exists() else None,
                weights_only=False,
            )
    except SystemExit:  # Lightning's answer to Ctrl-C, once it has closed its files
        raise KeyboardInterrupt from None
    # the last steps are the quietest, and no look need have followed them
    rates = {}
    for path in {last, Path(best.best_model_path or last)}:
        module.load_state_dict(_checkpoint(path)["state_dict"])
        rates[path] = held_out_air(*decode_pages(module.float().eval(), validation), pilot_mask, levels)
    chosen = max(rates, key=lambda path: rates[path])
    module.load_state_dict(_checkpoint(chosen)["state_dict"])
    return Fitted(module, rates[chosen], timer.time_elapsed())


@contextmanager
def _without_hints() -> Iterator[None]:
    """Keep to itself what Lightning would tell a programmer; its errors come through."""
    log = logging.getLogger("lightning.pytorch")
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", module=r"lightning\.")
            yield
    finally:
        log.setLevel(level)


def _checkpoint(path: Path) -> dict[str, Any]:
    return dict(torch.load(path, map_location="cpu", weights_only=False))


def decode_pages(module: DecoderTraining, pages: Dataset[Page]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """What a trained module says of pages, p [pages, 2, ny, nx], and their true phases [pages, ny, nx]."""
    outputs, truths = [], []
    with torch.no_grad():
        for light, positions, phases in DataLoader(pages, batch_size=None):
            outputs.append(module(light[None], positions[None])[0].float().numpy())
            truths.append(phases.numpy())
    return np.stack(outputs), np.stack(truths)


def best_kappa_scale(module: DecoderTraining, pages: Dataset[Page], mask: NDArray[np.bool_]) -> float:
    """Factor on p under which held-out pages are most likely: the network's claim, made honest.

    Piston is taken off by the pilots first, as the runtime does it.
    """
    outputs, truths = [], []
    for p, truth in zip(*decode_pages(module, pages), strict=True):
        pilots = Pilots(mask, truth[mask].astype(np.float64))
        turn = estimate_piston(p, pilots).angle_rad
        cos, sin = np.cos(turn), np.sin(turn)
        outputs.append(np.stack([p[0] * cos + p[1] * sin, p[1] * cos - p[0] * sin])[:, ~mask])
        truths.append(truth[~mask])
    p_all = torch.from_numpy(np.concatenate(outputs, axis=1))[None]
    truth_all = torch.from_numpy(np.concatenate(truths))[None]

    def nll(log_scale: float) -> float:
        return float(von_mises_nll(p_all * math.exp(log_scale), truth_all).mean())

    found = optimize.minimize_scalar(nll, bounds=(-1.5, 1.5), method="bounded")
    return math.exp(float(found.x))
