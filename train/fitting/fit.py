"""Training of a decoder network with Lightning: data on disk, checkpoints, resume, validation by AIR."""

from __future__ import annotations

import json
import logging
import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from pickle import UnpicklingError
from statistics import fmean
from typing import Any, Generic, TypeVar

import lightning as L
import numpy as np
import torch
from lightning.pytorch.callbacks import Callback, EMAWeightAveraging, ModelCheckpoint, Timer, TQDMProgressBar
from lightning.pytorch.loggers import TensorBoardLogger
from numpy.typing import NDArray
from scipy import optimize
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset, RandomSampler

from lightpage.cli.progress_bar import warn
from lightpage.device.profile import Profile
from lightpage.errors import InvalidInputError
from lightpage.files import replace_file, replace_text
from lightpage.metrics.information import achievable_rate, decide
from lightpage.page.pilots import Pilots, estimate_piston
from lightpage.waves.grid import GRID_STEP_PX, FieldGrid, field_grid
from train.fitting.curves import TENSORBOARD, Curve, curves_of, thinned
from train.fitting.loss import training_rate, von_mises_nll
from train.fitting.processes import process_number
from train.fitting.provenance import provenance_of
from train.models.field import ROUNDS
from train.models.localizers.coherent import BICUBIC, CoherentLocalizer
from train.models.network import Refiner, SymbolUNet
from train.models.parts import turned

CHECKPOINTS = "checkpoints"
"""Folder of a run's checkpoints."""
_LAST = "last.ckpt"
FITTED, FITTED_WEIGHTS = "fitted.json", "fitted.pt"
"""Of a run whose training is finished: what it reached, and the weights. They stand in for its checkpoints."""
_WANTED = f"{FITTED} and {FITTED_WEIGHTS} of one training, or neither, to train from the last checkpoint on"
_KEPT_POINTS = 60
"""Of each curve in what a finished training keeps."""
LOOKS = 60
"""How often a run looks at its validation pages."""
_REFINEMENT_STEPS = 0.25
"""Steps of a refinement's network over those of the first."""
_SCALE_BOUNDS = (-3.0, 3.0)
"""Bounds of the logarithm of a factor that makes a decoder's claims honest: hardly trained ones were off by five."""
_AT_A_BOUND = 1e-3
_FEWEST_STEPS = 2
"""That a learning rate can rise and fall in."""
_SEEDS_APART = 1_000_003
"""Of two processes of one run: further than any run has steps."""
AVERAGED_SHARE = 0.05
"""Share of a run's steps over which its weights are averaged, exponentially: what is validated, kept and exported."""


@dataclass(frozen=True)
class Hyperparameters:
    """Everything that a training run chooses.

    Attributes:
        channels, blocks, levels: size of the network, see `SymbolUNet`.
        refinements: how often the decoder looks again, see `train.trainers.refinement`.
        field_rounds, binning: of the field's recovery, see `train.models.field.FieldRecovery`.
        field_step: pitch of the common grid, camera pixels.
        samples, interpolation: see `CoherentLocalizer`.
        steps: optimiser steps.
        batch: pages a step, or patches of large ones.
        patch: symbols along a patch's edge; smaller pages are trained on whole.
        learning_rate: peak of the one-cycle schedule.
        weight_decay: of AdamW.
        seed: of initial weights, batches and rotations.
        precision: Lightning's; bf16-mixed is fastest on CPUs with bf16 and on GPUs.
    """

    channels: int = 96
    blocks: int = 2
    levels: int = 0
    refinements: int = 0
    field_rounds: int = ROUNDS
    binning: int = 1
    field_step: int = GRID_STEP_PX
    samples: int = 0
    interpolation: str = BICUBIC
    steps: int = 6000
    batch: int = 4
    patch: int = 96
    learning_rate: float = 4e-3
    weight_decay: float = 1e-3
    seed: int = 0
    precision: str = "bf16-mixed"

    @property
    def first_look(self) -> str:
        """What the features of the first look depend on."""
        return f"{self.field_rounds} {self.binning} {self.field_step} {self.samples} {self.interpolation}"

    def grid(self, profile: Profile) -> FieldGrid:
        """The common grid of these choices."""
        return field_grid(profile, self.field_step)

    def coherent_localizer(self, profile: Profile) -> CoherentLocalizer:
        """The localizer of these choices."""
        return CoherentLocalizer(profile, self.samples, self.interpolation, self.grid(profile))

    def drawn(self, page_shape: tuple[int, int]) -> float:
        """Pages that all steps together are shown, a patch counting for its share of one."""
        share = math.prod(min(count, self.patch) / count for count in page_shape)
        return self.steps * self.batch * share

    def of_refinement(self) -> Hyperparameters:
        """The choices for a refinement's network, which starts from a good belief and sees little light."""
        steps = max(_FEWEST_STEPS, round(_REFINEMENT_STEPS * self.steps))
        return replace(self, channels=max(1, self.channels * 2 // 3), blocks=1, levels=0, refinements=0, steps=steps)


SymbolNetwork = SymbolUNet | Refiner
Page = tuple[Tensor, ...]
"""One page, or a batch of them: what the decoder is told, and last its true phases [ny, nx]."""
N = TypeVar("N", bound=nn.Module)


class DecoderTraining(L.LightningModule, Generic[N]):
    """A decoder under the von Mises loss, validated by AIR.

    Pages to train on have phases that are NaN where nothing is asked; pages to validate with have all of theirs.

    Args:
        network: pages without their phases to p [N, 2, ny, nx].
        pilot_mask: bool [ny, nx]; pilots are no data: no figure counts them.
        levels: M of the pages, which bounds their AIR.
    """

    def __init__(self, network: N, pilot_mask: NDArray[np.bool_], levels: int) -> None:
        super().__init__()
        self.network = network
        self.pilot_mask, self.levels = pilot_mask, levels
        self._rates: list[float] = []

    def forward(self, *page: Tensor) -> Tensor:
        """A batch of pages to p [N, 2, ny, nx]."""
        return torch.as_tensor(self.network(*page))

    def loss(self, p: Tensor, phases: Tensor) -> Tensor:
        """Mean over the symbols that are asked for, logged."""
        asked = torch.isfinite(phases)
        loss = von_mises_nll(p, torch.where(asked, phases, 0.0))[asked].mean()
        self.log("train_nll", loss, prog_bar=True)
        rate = training_rate(p.movedim(1, 0)[:, asked], phases[asked], self.levels)
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

    Its pages are light [N, 2 C, ny, nx], exit centroids [N, 2, ny, nx], for a `Refiner` what is believed so far
    [N, 2, ny, nx], and true phases [N, ny, nx].

    Args:
        network, pilot_mask, levels: as for `DecoderTraining`.
        hyperparameters: the run's choices.
    """

    def __init__(
        self, network: SymbolNetwork, hyperparameters: Hyperparameters, pilot_mask: NDArray[np.bool_], levels: int
    ) -> None:
        super().__init__(network, pilot_mask, levels)
        self.choices = hyperparameters

    def forward(self, *page: Tensor) -> Tensor:
        """Light, exit centroids and what is believed so far to p [N, 2, ny, nx]."""
        light, *others = page
        return torch.as_tensor(self.network(light.float(), *others))

    def training_step(self, batch: Page, index: int) -> Tensor:
        """Loss of pages whose field and symbols were turned by one random angle each: piston is no information."""
        light, positions, *belief, phases = batch
        turn = 2 * math.pi * torch.rand(len(light), 1, 1, device=light.device)
        shown = [_turned(part, turn) for part in (light.float(), *belief)]
        return self.loss(self(shown[0], positions, *shown[1:]), phases + turn)

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


def held_out_air(p: NDArray[np.float32], phases: NDArray[np.float32], mask: NDArray[np.bool_], levels: int) -> float:
    """AIR in bits per data symbol of decoded pages.

    Args:
        p: [pages, 2, ny, nx].
        phases: true phases [pages, ny, nx].
        mask: pilots, bool [ny, nx].
        levels: M of the pages.
    """
    rates = []
    for page, truth in zip(p, phases, strict=True):
        px, py = without_piston(page, truth, mask)[:, ~mask]
        air = achievable_rate(np.arctan2(py, px), np.hypot(px, py), decide(truth[~mask], levels), levels)
        rates.append(float(np.mean(air)))
    return float(np.mean(rates))


def without_piston(p: NDArray[np.float32], phases: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[np.float32]:
    """p [2, ny, nx] of a page, turned by what its pilots show of the piston, as the runtime does it.

    Args:
        p: decoded.
        phases: true phases [ny, nx].
        mask: pilots, bool [ny, nx].
    """
    turn = estimate_piston(p, Pilots(mask, phases[mask].astype(np.float64))).angle_rad
    return np.asarray(turned(torch.tensor(p), -turn).numpy(), dtype=np.float32)


M = TypeVar("M", bound=DecoderTraining[Any])


@dataclass(frozen=True)
class Fitted(Generic[M]):
    """A trained module.

    Attributes:
        module: the best one, in float32.
        validation_air: its AIR on the validation pages, bits per data symbol.
        seconds: of training, all stretches of an interrupted run together.
        curves: of `train.fitting.curves.CURVES`, thinned; none in the processes of further devices.
    """

    module: M
    validation_air: float
    seconds: float
    curves: dict[str, Curve]

    def save(self, run: Path) -> None:
        """Keep it in the folder of its run, weights first: what is said to be finished is whole."""
        replace_file(run / FITTED_WEIGHTS, partial(torch.save, self.module.network.state_dict()), "weights")
        kept = {"validation_air": self.validation_air, "seconds": self.seconds, "made_by": provenance_of(run)}
        kept["curves"] = self.curves
        replace_text(run / FITTED, json.dumps(kept, indent=1) + "\n", "result of a training")


def finished(run: Path, module: M) -> Fitted[M] | None:
    """What an earlier call of `fit` made of the module of a run, None if it is not there.

    Raises:
        InvalidInputError: it is damaged, or of another module.
    """
    if not (run / FITTED).exists():
        return None
    kept = _kept(run)
    try:
        module.network.load_state_dict(torch.load(run / FITTED_WEIGHTS, map_location="cpu", weights_only=True))
    except (OSError, RuntimeError, EOFError, UnpicklingError) as error:
        raise InvalidInputError(f"finished training {run / FITTED_WEIGHTS}", error, _WANTED) from None
    return Fitted(module.float().eval(), **kept)


def fitted_curves(run: Path) -> dict[str, Curve]:
    """The curves that a finished training kept, thinned; none of another run.

    Raises:
        InvalidInputError: what it kept is damaged.
    """
    return _kept(run)["curves"] if (run / FITTED).exists() else {}


def _kept(run: Path) -> dict[str, Any]:
    """What a finished training says of itself, as `Fitted` has it."""
    try:
        kept = json.loads((run / FITTED).read_text())
        curves = {str(name): [(int(step), float(value)) for step, value in c] for name, c in kept["curves"].items()}
        return {"validation_air": float(kept["validation_air"]), "seconds": float(kept["seconds"]), "curves": curves}
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise InvalidInputError(f"finished training {run / FITTED}", repr(error), _WANTED) from None


def fit_network(
    run: Path,
    hyperparameters: Hyperparameters,
    pilot_mask: NDArray[np.bool_],
    levels: int,
    training: Dataset[Page],
    validation: Dataset[Page],
    *,
    kind: type[SymbolUNet] | type[Refiner] = SymbolUNet,
    start: nn.Module | None = None,
    devices: int | str = "auto",
    progress: bool = True,
) -> Fitted[SymbolTraining]:
    """Train, or go on with, the network of a run: see `fit`.

    Args:
        run, validation, devices, progress: as for `fit`.
        training: pages whose phases are NaN where nothing is asked (`train.data.patches.training_pages`).
        hyperparameters: the run's choices.
        pilot_mask: bool [ny, nx].
        levels: M of the pages.
        kind: of the network.
        start: network of the same kind and size whose weights a new run begins with; random ones if left out.
    """
    seed_stretch(run, hyperparameters.seed)
    light_channels = training[0][0].shape[0]
    network = kind(light_channels, hyperparameters.channels, hyperparameters.blocks, hyperparameters.levels)
    if start is not None:
        network.load_state_dict(start.state_dict())
    module = SymbolTraining(network, hyperparameters, pilot_mask, levels)
    draws = hyperparameters.batch * max(1, hyperparameters.steps // LOOKS)
    sampler = RandomSampler(training, replacement=True, num_samples=draws)  # type: ignore[arg-type]  # it has a length
    averaged = EMAWeightAveraging(use_buffers=False, decay=1 - 1 / max(1.0, AVERAGED_SHARE * hyperparameters.steps))
    return fit(
        run,
        module,
        DataLoader(training, batch_size=hyperparameters.batch, sampler=sampler),
        validation,
        steps=hyperparameters.steps,
        precision=hyperparameters.precision,
        callbacks=[averaged],
        devices=devices,
        progress=progress,
    )


def seed_stretch(run: Path, seed: int) -> None:
    """Seed everything for a run: its next stretch, and each of its processes, draw other pages and turns."""
    last = run / CHECKPOINTS / _LAST
    reached = int(_checkpoint(last)["global_step"]) if last.exists() else 0
    L.seed_everything(seed + reached + _SEEDS_APART * process_number(), verbose=False)


def fit(
    run: Path,
    module: M,
    training: DataLoader[Page],
    validation: Dataset[Page],
    *,
    steps: int,
    precision: str,
    callbacks: Sequence[Callback] = (),
    devices: int | str = "auto",
    progress: bool = True,
) -> Fitted[M]:
    """Train, or go on with, the module of a run, looking at its validation pages after every pass of `training`.

    What a finished training made is kept in the folder and returned when it is asked for again. On several devices
    Lightning runs the program once for each; all of them return the same.

    Raises KeyboardInterrupt after Ctrl-C, with the last checkpoint in place.

    Args:
        run: folder of the run; checkpoints and TensorBoard logs go there, and the last checkpoint is resumed from: the
            caller sees to it that it belongs to these pages and choices (`train.runs.begin`).
        module: with its first weights.
        training: batches of pages whose phases are NaN where nothing is asked.
        validation: pages.
        steps: optimiser steps.
        precision: Lightning's.
        callbacks: further Lightning callbacks.
        devices: how many GPUs, or processes where there is none; "auto" takes all GPUs, or one process.
        progress: whether to show a bar.
    """
    if (before := finished(run, module)) is not None:
        return before
    provenance_of(run)  # notes who begins it
    folder = run / CHECKPOINTS
    last = folder / _LAST
    best = ModelCheckpoint(folder, "best", monitor="val_air", mode="max")
    newest = ModelCheckpoint(folder, last.stem, save_on_train_epoch_end=True, enable_version_counter=False)
    timer = Timer()
    with _without_hints():
        trainer = L.Trainer(
            max_steps=steps,
            precision=precision,  # type: ignore[arg-type]
            logger=TensorBoardLogger(str(run), name="", version=TENSORBOARD),
            callbacks=[*callbacks, best, timer, newest, *([_Bar()] if progress else [])],
            devices=devices,
            enable_progress_bar=progress,
            enable_model_summary=False,
            gradient_clip_val=1.0,
            use_distributed_sampler=False,  # each process draws its own pages, and validates all
            num_sanity_val_steps=0,
            log_every_n_steps=10,
            default_root_dir=run,
        )
    try:
        with _without_hints():
            trainer.fit(
                module,
                training,
                DataLoader(validation, batch_size=1),
                ckpt_path=last if last.exists() else None,
                weights_only=False,
            )
    except SystemExit:  # Lightning's answer to Ctrl-C, once it has closed its files
        raise KeyboardInterrupt from None
    # the last steps are the quietest, and no look need have followed them
    rates = {}
    for path in {last, folder / Path(best.best_model_path or last).name}:  # the run may have been moved meanwhile
        module.load_state_dict(_checkpoint(path)["state_dict"])
        module.float().eval()
        with torch.no_grad():
            rates[path] = fmean(module.rate(page) for page in DataLoader(validation, batch_size=1))
    chosen = max(rates, key=lambda path: rates[path])
    module.load_state_dict(_checkpoint(chosen)["state_dict"])
    fitted = Fitted(module, rates[chosen], timer.time_elapsed(), {})
    if trainer.is_global_zero:
        fitted = replace(fitted, curves={name: thinned(curve, _KEPT_POINTS) for name, curve in curves_of(run).items()})
        fitted.save(run)
    return fitted


class _Bar(TQDMProgressBar):
    """Lightning's, without the version of the log: there is one."""

    def get_metrics(self, trainer: L.Trainer, pl_module: L.LightningModule) -> dict[str, Any]:
        return {name: value for name, value in super().get_metrics(trainer, pl_module).items() if name != "v_num"}


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


def decode_pages(module: DecoderTraining[Any], pages: Dataset[Page]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """What a trained module says of pages, p [pages, 2, ny, nx], and their true phases [pages, ny, nx]."""
    outputs, truths = [], []
    with torch.no_grad():
        for *page, phases in DataLoader(pages, batch_size=None):
            outputs.append(module(*(part[None] for part in page))[0].float().numpy())
            truths.append(phases.numpy())
    return np.stack(outputs), np.stack(truths)


def best_kappa_scale(module: DecoderTraining[Any], pages: Dataset[Page], mask: NDArray[np.bool_]) -> float:
    """Factor on p under which held-out pages are most likely: the network's claim, made honest.

    Piston is taken off by the pilots first, as the runtime does it.
    """
    outputs, truths = [], []
    for p, truth in zip(*decode_pages(module, pages), strict=True):
        outputs.append(without_piston(p, truth, mask)[:, ~mask])
        truths.append(truth[~mask])
    return honest_factor(np.concatenate(outputs, axis=1), np.concatenate(truths))


def honest_factor(p: NDArray[np.float32], phases: NDArray[np.float32]) -> float:
    """Factor on p [2, N] under which the true phases [N] are most likely."""
    shown, asked = torch.from_numpy(p)[None], torch.from_numpy(phases)[None]
    return most_likely_factor(lambda factor: float(von_mises_nll(shown * factor, asked).mean()))


def most_likely_factor(nll: Callable[[float], float]) -> float:
    """Factor under which the truth is most likely; says so where the search ends at a bound.

    Args:
        nll: negative log-likelihood of the truth, by factor.
    """
    found = optimize.minimize_scalar(lambda log: nll(math.exp(log)), bounds=_SCALE_BOUNDS, method="bounded")
    log_factor = float(found.x)
    if min(log_factor - _SCALE_BOUNDS[0], _SCALE_BOUNDS[1] - log_factor) < _AT_A_BOUND:
        what = f"claims would be more honest still beyond the factor {math.exp(log_factor):.3g}, where the search ends"
        warn(f"{what}: is the decoder trained?")
    return math.exp(log_factor)
