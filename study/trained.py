"""Published decoders trained on a simulated device, for the studies that ask what they reach there."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
from lightning.pytorch.callbacks import Callback
from numpy.typing import NDArray

from lightpage.device.profile import Profile
from lightpage.metrics.information import page_kilobytes
from lightpage.page.symbols import pilot_mask
from lightpage.progress import Progress, reporting
from lightpage.study.judged import estimates, figures_of_classes, figures_of_p, user_bytes
from lightpage.study.lights import DataSet
from lightpage.study.study import Result, Settings
from lightpage.train.fitting.concentration_scale import calibrating_factor
from lightpage.train.fitting.curves import curves_of
from lightpage.train.processes import Processes
from lightpage.train.published.held_pages import HeldPages
from lightpage.train.published.trainer import published_choices, train_published
from lightpage.train.published.training import PublishedChoices
from lightpage.train.runs import begin

PAGES = 500
"""Pages of a data set: nine tenths to train on, the rest in halves to validate and to judge by."""
_QUICK_PAGES = 12
_QUICK = {"channels": (4, 8), "steps": 12}
_HELD_SHARE = 0.05


def split(settings: Settings) -> tuple[range, range, range]:
    """Numbers of the pages to train on, to validate with and to judge by."""
    pages = _QUICK_PAGES if settings.quick else PAGES
    held = max(2, round(_HELD_SHARE * pages))
    return range(pages - 2 * held), range(pages - 2 * held, pages - held), range(pages - held, pages)


def trained(
    settings: Settings,
    data_set: DataSet,
    localizer: str,
    work: Path,
    progress: Progress,
    *,
    knows_piston: bool = False,
    **changes: Any,
) -> Result:
    """Train a published decoder on a simulated device as its authors did, and return its figures on held-out pages.

    Piston and shift of the pages are those that were simulated. Pages of one data set are held at a time, so cases on
    one should follow each other.

    Args:
        settings: settings of the study.
        data_set: device to train on.
        localizer: none, mode or ray.
        work: folder of the case.
        progress: told of the steps.
        knows_piston: whether a page's piston is told when the decoder is judged too, as classes need it; else pilots
            show it.
        changes: changes to `PublishedChoices`, where the study asks for others than the authors'.

    Returns:
        air, own_mi: bits per data symbol; own_mi_claimed: the same before the factor that calibrates concentrations, as
        the authors count; air_kB, own_mi_kB, own_mi_claimed_kB a page; user_bytes that a code carries; ece; steps; the
        maps air_map, own_mi_map and error_map (mean magnitude of the phase error, radians), [ny, nx], NaN at pilots;
        training_curve and validation_curve (AIR) and angles (pipe angle, degrees), [points, 2], step first; angle_deg
        of the decoder that is judged, not a number where it has none. With classes, air_map, own_mi_map and ece are
        those of its posteriors over classes, and air_of_p is that of p.
    """
    profile, levels, lights = data_set.profile, data_set.levels, settings.lights
    parts = split(settings)
    made = lights.of(data_set, parts[-1].stop, settings.seed, progress)
    training, validation, unseen = (HeldPages(made, part) for part in parts)
    choices = chosen(settings, localizer, profile, len(training), **changes)
    mask = pilot_mask(profile)
    begin(work, choices.kept() | {"localizer": localizer})
    processes, tell = Processes(1, compute=lights.compute), _Tell(progress, choices)
    turn = data_set.device.homodyne.turn_rad
    with reporting(None):  # the case's own progress is shown
        fitted = train_published(
            work, localizer, choices, profile, turn, mask, training, validation, callbacks=[tell], processes=processes
        )
    module = fitted.module.to(made.frames.device)
    p, phases = estimates(module, validation, mask, knows_piston)
    scale = calibrating_factor(p.reshape(2, -1), phases.ravel())
    p, phases = estimates(module, unseen, mask, knows_piston)
    claimed = _mean(figures_of_p(p, phases, mask, levels)["own_mi_map"])
    figures = figures_of_p(scale * p, phases, mask, levels)
    read = user_bytes(scale * p, phases, mask)
    if choices.classes:
        of_classes = figures_of_classes(module, validation, unseen, mask)
        figures = {"air_of_p": _mean(figures["air_map"])} | figures | of_classes
    angle = getattr(module.network.localizer, "angle", None)
    air, own, data = _mean(figures["air_map"]), _mean(figures["own_mi_map"]), int((~mask).sum())
    return {
        "air": air,
        "own_mi": own,
        "air_kB": page_kilobytes(air, data),
        "own_mi_kB": page_kilobytes(own, data),
        "own_mi_claimed": claimed,
        "own_mi_claimed_kB": page_kilobytes(claimed, data),
        "user_bytes": read,
        "steps": choices.steps,
        "angle_deg": float("nan") if angle is None else math.degrees(angle.item()),
        **figures,
        **curves_in(work),
    }


def chosen(settings: Settings, localizer: str, profile: Profile, pages: int, **changes: Any) -> PublishedChoices:
    """The authors' choices for a device's symbols and so many training pages, as far as the study goes with them."""
    choices = replace(published_choices(localizer, profile, pages), **{"seed": settings.seed, **changes})
    if settings.quick:
        choices = replace(choices, **_QUICK)  # type: ignore[arg-type]
    else:
        choices = replace(choices, channels=(settings.channels, 2 * settings.channels))
    return replace(choices, steps=max(1, round(settings.share * choices.steps)))


class _Tell(Callback):
    """Passes Lightning's steps on."""

    def __init__(self, progress: Progress, choices: PublishedChoices) -> None:
        self._progress, self._steps = progress, choices.steps

    def on_train_batch_end(self, trainer: L.Trainer, *_: Any) -> None:
        self._progress("train", trainer.global_step / self._steps)


def _mean(values: NDArray[np.float32]) -> float:
    return float(np.nanmean(values))


def curves_in(run: Path) -> dict[str, NDArray[np.float64]]:
    """Return `training_curve`, `validation_curve` and `angles` of a run, see `trained`."""
    names = {"training_curve": "train_air", "validation_curve": "val_air", "angles": "angle_deg"}
    curves = curves_of(run)
    return {name: np.array(curves.get(tag, []), dtype=np.float64).reshape(-1, 2) for name, tag in names.items()}
