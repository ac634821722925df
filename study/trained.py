"""Published decoders trained on a simulated device, for the studies that ask what they reach there."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import lightning as L
import numpy as np
from lightning.pytorch.callbacks import Callback
from numpy.typing import NDArray

from lightpage.device.profile import Profile
from lightpage.device.state import Device
from lightpage.metrics.information import page_kilobytes
from lightpage.page.symbols import pilot_mask
from lightpage.progress import Progress, reporting
from lightpage.recording.reader import Recording
from lightpage.simulator.recording_job import RecordingJob
from lightpage.study.judged import estimates, figures_of_classes, figures_of_p
from lightpage.study.study import Result, Settings
from lightpage.train.data.features import PageState
from lightpage.train.fitting.concentration_scale import calibrating_factor
from lightpage.train.fitting.curves import curves_of
from lightpage.train.published.trainer import published_choices, train_published
from lightpage.train.published.training import FramePages, PublishedChoices
from lightpage.train.runs import begin

LEVELS = 256
PAGES = 500
"""Recorded: nine tenths to train on, the rest in halves to validate and to judge by."""
_QUICK_PAGES = 12
_QUICK = {"channels": (4, 8), "steps": 12}
_HELD_SHARE = 0.05


@dataclass(frozen=True)
class DataSet:
    """A recording of a simulated device that several decoders are trained on.

    Attributes:
        name: name of its file, beside the folders of the cases; it stays, so that an interrupted study finds it again.
        profile, device: nominal and true.
        levels: M of its pages.
    """

    name: str
    profile: Profile
    device: Device
    levels: int = LEVELS


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

    Piston and shift of the pages are those that were simulated. Recordings are large: those of other data sets are
    dropped, so cases on one data set should follow each other.

    Args:
        settings: settings of the study.
        data_set: recording to train on.
        localizer: none, mode or ray.
        work: folder of the case.
        progress: told of the steps.
        knows_piston: whether a page's piston is told when the decoder is judged too, as classes need it; else pilots
            show it.
        changes: changes to `PublishedChoices`, where the study asks for others than the authors'.

    Returns:
        air, own_mi: bits per data symbol; air_kB, own_mi_kB a page; ece; steps; the maps air_map, own_mi_map and
        error_map (mean magnitude of the phase error, radians), [ny, nx], NaN at pilots; training_curve and
        validation_curve (AIR) and angles (pipe angle, degrees), [points, 2], step first; angle_deg of the decoder that
        is judged, not a number where it has none. With classes, air_map,
        own_mi_map and ece are those of its posteriors over classes, and air_of_p is that of p.
    """
    profile, device, levels = data_set.profile, data_set.device, data_set.levels
    pages = _QUICK_PAGES if settings.quick else PAGES
    path = work.parent / f"{data_set.name}.h5"
    progress("record", 0.0)
    if not path.exists():
        for other in work.parent.glob("*.h5"):
            other.unlink()
        job = RecordingJob(profile, device, levels, settings.seed, truth=True, out=path)
        job.claim(force=False)
        job.run(pages)
    held = max(2, round(_HELD_SHARE * pages))
    first, second = pages - 2 * held, pages - held
    choices = chosen(settings, localizer, profile, first, **changes)
    mask = pilot_mask(profile)
    begin(work, asdict(choices) | {"channels": list(choices.channels), "localizer": localizer})
    with Recording.open(path) as recording:
        states = _true_states(path)
        training, validation, unseen = (
            FramePages(recording, part, [states[page] for page in part])
            for part in (range(first), range(first, second), range(second, pages))
        )
        quadrature_phase, tell = device.homodyne.turn_rad, _Tell(progress, choices)
        with reporting(None):  # the case's own progress is shown
            fitted = train_published(
                work, localizer, choices, profile, quadrature_phase, mask, training, validation, callbacks=[tell]
            )
        p, phases = estimates(fitted.module, validation, mask, knows_piston)
        scale = calibrating_factor(p.reshape(2, -1), phases.ravel())
        p, phases = estimates(fitted.module, unseen, mask, knows_piston)
        figures = figures_of_p(scale * p, phases, mask, levels)
        if choices.classes:
            of_classes = figures_of_classes(fitted.module, validation, unseen, mask)
            figures = {"air_of_p": _mean(figures["air_map"])} | figures | of_classes
    angle = getattr(fitted.module.network.localizer, "angle", None)
    air, own, data = _mean(figures["air_map"]), _mean(figures["own_mi_map"]), int((~mask).sum())
    return {
        "air": air,
        "own_mi": own,
        "air_kB": page_kilobytes(air, data),
        "own_mi_kB": page_kilobytes(own, data),
        "steps": choices.steps,
        "angle_deg": float("nan") if angle is None else math.degrees(angle.item()),
        **figures,
        **_curves(work),
    }


def chosen(settings: Settings, localizer: str, profile: Profile, pages: int, **changes: Any) -> PublishedChoices:
    """The authors' choices for a device's symbols and so many training pages, as far as the study goes with them."""
    choices = replace(published_choices(localizer, profile, pages), seed=settings.seed, **changes)
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


def _true_states(path: Path) -> list[PageState]:
    with h5py.File(str(path)) as file:
        shifts, pistons = file["truth/shift_px"][:], file["truth/piston"][:]
    return [PageState((float(x), float(y)), float(p)) for (x, y), p in zip(shifts, pistons, strict=True)]


def _mean(values: NDArray[np.float32]) -> float:
    return float(np.nanmean(values))


def _curves(work: Path) -> dict[str, NDArray[np.float64]]:
    names = {"training_curve": "train_air", "validation_curve": "val_air", "angles": "angle_deg"}
    curves = curves_of(work)
    return {name: np.array(curves.get(tag, []), dtype=np.float64).reshape(-1, 2) for name, tag in names.items()}
