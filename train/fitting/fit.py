"""Training of a decoder network with Lightning: data on disk, checkpoints, resume, validation by AIR."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import fmean
from typing import Any

import lightning as L
import numpy as np
import torch
from lightning.pytorch.callbacks import Callback, EMAWeightAveraging, ModelCheckpoint, Timer
from lightning.pytorch.loggers import TensorBoardLogger
from numpy.typing import NDArray
from torch import nn
from torch.utils.data import DataLoader, Dataset, RandomSampler

from lightpage.errors import LightpageError
from lightpage.page.levels import Levels
from lightpage.progress import track
from lightpage.train.data.pages import Page
from lightpage.train.fitting.curves import TENSORBOARD, curves_of, thinned
from lightpage.train.fitting.fitted import CHECKPOINTS, KEPT_POINTS, Fitted, M, finished, is_finished
from lightpage.train.fitting.modules import AVERAGED_SHARE, SymbolTraining
from lightpage.train.fitting.precision import lightning_precision
from lightpage.train.fitting.provenance import provenance_of
from lightpage.train.models.hyperparameters import Hyperparameters
from lightpage.train.models.network import Refiner, SymbolUNet
from lightpage.train.processes import AS_IT_IS, Processes, is_first_process, process_number, wait_for_first

_LAST = "last.ckpt"

VALIDATIONS = 60
"""Number of validations of a run."""

_SEEDS_APART = 1_000_003
"""Distance of the seeds of two processes of one run: further than any run has steps."""

_SEEDS = 2**32
"""Number of seeds that Lightning takes."""


def fit_network(
    run: Path,
    hyperparameters: Hyperparameters,
    pilot_mask: NDArray[np.bool_],
    levels: int | Levels,
    training: Dataset[Page],
    validation: Dataset[Page],
    *,
    kind: type[SymbolUNet] | type[Refiner] = SymbolUNet,
    start: nn.Module | None = None,
    processes: Processes = AS_IT_IS,
) -> Fitted[SymbolTraining]:
    """Train, or go on with, the network of a run: see `fit`.

    Args:
        run, validation, processes: see `fit`.
        training: pages whose phases are NaN where nothing is asked (`lightpage.train.data.patches.training_pages`).
        hyperparameters: the run's choices.
        pilot_mask: bool [ny, nx].
        levels: levels of the pages.
        kind: kind of the network.
        start: network of the same kind and size whose weights a new run begins with; random ones if left out.
    """
    seed_stretch(run, hyperparameters.seed)
    light_channels = training[0][0].shape[0]
    network = kind(light_channels, hyperparameters.channels, hyperparameters.blocks, hyperparameters.depth)
    if start is not None:
        network.load_state_dict(start.state_dict())
    module = SymbolTraining(network, hyperparameters, pilot_mask, levels)
    draws = hyperparameters.batch * max(1, hyperparameters.steps // VALIDATIONS)
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
        processes=processes,
    )


def seed_stretch(run: Path, seed: int) -> None:
    """Seed everything for a run: its next stretch, and each of its processes, draw other pages and turns."""
    last = run / CHECKPOINTS / _LAST
    reached = int(_checkpoint(last)["global_step"]) if last.exists() else 0
    L.seed_everything((seed + reached + _SEEDS_APART * process_number()) % _SEEDS, verbose=False)


def fit(
    run: Path,
    module: M,
    training: DataLoader[Page],
    validation: Dataset[Page],
    *,
    steps: int,
    precision: str,
    callbacks: Sequence[Callback] = (),
    processes: Processes = AS_IT_IS,
) -> Fitted[M]:
    """Train, or go on with, the module of a run, judging it by its validation pages after every pass of `training`.

    What a finished training made is kept in the folder and returned when it is asked for again. On several devices
    Lightning runs the program once for each; all of them return the same.

    The trained module is on the CPU.

    Raises KeyboardInterrupt after Ctrl-C, with the last checkpoint in place, and LightpageError where another process
    has ended.

    Args:
        run: folder of the run; checkpoints and TensorBoard logs go there, and the last checkpoint is resumed from: the
            caller sees to it that it belongs to these pages and choices (`lightpage.train.runs.begin`).
        module: module with its first weights.
        training: batches of pages whose phases are NaN where nothing is asked.
        validation: pages.
        steps: optimiser steps.
        precision: name out of `PRECISIONS`.
        callbacks: further Lightning callbacks.
        processes: processes that work together; by default all GPUs, or one process.
    """
    if (before := finished(run, module)) is not None:
        return before
    if is_first_process():
        provenance_of(run)  # notes who begins it
    folder = run / CHECKPOINTS
    last = folder / _LAST
    best = ModelCheckpoint(folder, "best", monitor="val_air", mode="max")
    newest = ModelCheckpoint(folder, last.stem, save_on_train_epoch_end=True, enable_version_counter=False)
    timer = Timer()
    with _without_hints():
        trainer = L.Trainer(
            max_steps=steps,
            precision=lightning_precision(precision, processes.device),  # type: ignore[arg-type]
            logger=TensorBoardLogger(str(run), name="", version=TENSORBOARD),
            callbacks=[*callbacks, best, timer, newest, _Steps()],
            accelerator=processes.accelerator,
            devices=processes.chosen_devices,
            num_nodes=processes.nodes,
            strategy=processes.strategy,
            plugins=[processes.environment()],
            enable_progress_bar=False,
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
                weights_only=True,
            )
    except SystemExit:  # Lightning's answer to Ctrl-C, once it has closed its files
        raise KeyboardInterrupt from None
    except RuntimeError as error:
        if trainer.world_size > 1 and (isinstance(error, torch.distributed.DistError) or "gloo" in str(error)):
            expected = "all of them: run the same commands again, they go on from the last checkpoint"
            raise LightpageError(f"training in {run}", "the end of another process", expected) from error
        raise
    if not is_first_process():  # on another machine the same pages may give another digit
        wait_for_first(lambda: int(is_finished(run)), 1, f"training in {run}")
        found = finished(run, module)
        assert found is not None  # it was waited for
        return found
    # the last steps are the quietest, and no validation need have followed them
    rates, device = {}, trainer.strategy.root_device
    for path in {last, folder / Path(best.best_model_path or last).name}:  # the run may have been moved meanwhile
        module.load_state_dict(_checkpoint(path)["state_dict"])
        module.float().eval().to(device)
        with torch.no_grad():
            batches = (tuple(part.to(device) for part in page) for page in DataLoader(validation, batch_size=1))
            rates[path] = fmean(map(module.rate, batches))
    module.cpu()
    chosen = max(rates, key=lambda path: rates[path])
    module.load_state_dict(_checkpoint(chosen)["state_dict"])
    curves = {name: thinned(curve, KEPT_POINTS) for name, curve in curves_of(run).items()}
    fitted = Fitted(module, rates[chosen], timer.time_elapsed(), curves)
    fitted.save(run)
    return fitted


class _Steps(Callback):
    """Tells of the steps as all long work does (`lightpage.progress`), with the latest validation AIR."""

    def __init__(self) -> None:
        self._steps: Iterator[int] = iter(())

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        def state() -> str:
            air = trainer.callback_metrics.get("val_air")
            return "" if air is None else f"validation AIR {float(air):.3f} bits/symbol"

        if trainer.is_global_zero:
            done, total = trainer.global_step, trainer.max_steps
            self._steps = iter(track(range(done, total), "training", unit="step", total=total, done=done, state=state))
            next(self._steps, None)

    def on_train_batch_end(self, *_: object) -> None:
        next(self._steps, None)


@contextmanager
def _without_hints() -> Iterator[None]:
    """Keep to itself what Lightning would tell a programmer; its errors come through."""
    logs = [logging.getLogger(name) for name in ("lightning.pytorch", "lightning.fabric")]
    levels = [log.level for log in logs]
    for log in logs:
        log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", module=r"lightning\.")
            yield
    finally:
        for log, level in zip(logs, levels, strict=True):
            log.setLevel(level)


def _checkpoint(path: Path) -> dict[str, Any]:
    return dict(torch.load(path, map_location="cpu", weights_only=True))
