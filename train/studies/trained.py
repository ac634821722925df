"""Published decoders trained on a simulated device, for the studies that ask what they reach there."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import h5py
import lightning as L
import numpy as np
from lightning.pytorch.callbacks import Callback
from numpy.typing import NDArray
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from optics.device import (
    Aberration,
    CameraPose,
    Device,
    Drift,
    Geometry,
    Homodyne,
    Reference,
    SlmDefects,
)
from optics.measures import achievable_rate, own_information
from optics.page import pilot_mask
from optics.profile import Profile
from optics.progress import Progress
from optics.recording import Recording
from optics.recording_job import RecordingJob
from train.features import PageState
from train.fitting import best_kappa_scale, decode_pages, seed_stretch, without_piston
from train.published.recipe import published_choices, published_decoder
from train.published.training import FramePages, PublishedChoices, PublishedTraining, fit_published
from train.run import begin
from train.studies.study import Result, Settings

LEVELS = 256
PAGES = 500
"""Recorded: nine tenths to train on, the rest in halves to validate and to judge by."""
_QUICK_PAGES = 12
_QUICK = {"channels": (4, 8), "steps": 12}
_HELD_SHARE = 0.05


def ideal_device() -> Device:
    """A device without any defect but camera noise, its pipe square: as the publication simulates it."""
    pose = CameraPose()
    return Device(
        geometry=Geometry(pipe_angle_deg=0, page_shift_x_px=0, page_shift_y_px=0, pipe_roll_deg=0),
        in_phase_camera=pose,
        quadrature_camera=pose,
        aberration=Aberration(distortion_relative=0, defocus_rad=0, astigmatism_rad=0, coma_rad=0),
        reference=Reference(ripple_relative=0, tilt_x_rad=0, tilt_y_rad=0, curvature_rad=0),
        homodyne=Homodyne(quadrature_error_deg=0, quadrature_gain=1),
        slm=SlmDefects(phase_noise_rad=0, blur_px=0, falloff_relative=0),
        drift=Drift(piston_rad=0, shift_px=0),
    )


def with_symbols_of(profile: Profile, size_px: int) -> Profile:
    """The device with symbols of another size on about the same part of the modulator."""
    page = profile.page
    columns, rows = (count * page.symbol_size_px // size_px for count in (page.columns, page.rows))
    update = {"columns": columns, "rows": rows, "symbol_size_px": size_px}
    return profile.model_copy(update={"page": page.model_copy(update=update)})


def trained(
    settings: Settings, profile: Profile, device: Device, localizer: str, light: str, work: Path, progress: Progress
) -> Result:
    """What a published decoder reaches on held-out pages of a simulated device, trained as its authors did.

    Piston and shift of the pages are those that were simulated.

    Args:
        settings: of the study.
        profile, device: nominal and true.
        localizer: none, mode or ray.
        light: name of the recording, which decoders of the same light share.
        work: folder of the case; recordings lie beside it.
        progress: told of the steps.

    Returns:
        air, own_mi: bits per data symbol; air_kB, own_mi_kB a page; steps; the maps air_map, own_mi_map and error_map
        (root mean square phase error, radians), [ny, nx], NaN at pilots; curves: [points, 3] of step, AIR on the
        training batch and on the validation pages; angles: [points, 2] of step and fitted pipe angle, degrees.
    """
    pages = _QUICK_PAGES if settings.quick else PAGES
    path = work.parent / f"{light}.h5"
    progress("record", 0.0)
    if not path.exists():
        job = RecordingJob(profile, device, LEVELS, settings.seed, truth=True, out=path)
        job.claim(force=False)
        job.run(pages)
    held = max(2, round(_HELD_SHARE * pages))
    first, second = pages - 2 * held, pages - held
    training, validation, unseen = range(first), range(first, second), range(second, pages)
    choices = replace(published_choices(profile, len(training)), seed=settings.seed)
    if settings.quick:
        choices = replace(choices, **_QUICK)  # type: ignore[arg-type]
    mask = pilot_mask(profile)
    begin(work, asdict(choices) | {"channels": list(choices.channels), "localizer": localizer})
    with Recording.open(path) as recording:
        states = _true_states(path)
        parts = [
            FramePages(recording, part, [states[page] for page in part]) for part in (training, validation, unseen)
        ]
        seed_stretch(work, choices.seed)
        turn = device.homodyne.turn_rad
        decoder = published_decoder(localizer, choices, profile, recording.references(), turn)
        module = PublishedTraining(decoder, choices, mask, LEVELS)
        tell = _Tell(progress, choices)
        fitted = fit_published(work, module, parts[0], parts[1], callbacks=[tell], progress=False)
        scale = best_kappa_scale(fitted.module, parts[1], mask)
        p, phases = decode_pages(fitted.module, parts[2])
    maps = _maps(p * scale, phases, mask)
    air, own = (float(np.nanmean(maps[name])) for name in ("air_map", "own_mi_map"))
    data = int((~mask).sum())
    curves = _curves(work / "tensorboard")
    return {
        "air": air,
        "own_mi": own,
        "air_kB": air * data / 8000,
        "own_mi_kB": own * data / 8000,
        "steps": choices.steps,
        **maps,
        **curves,
    }


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


def _maps(
    p: NDArray[np.float32], phases: NDArray[np.float32], mask: NDArray[np.bool_]
) -> dict[str, NDArray[np.float32]]:
    """Means over the pages, symbol by symbol."""
    rates, claims, errors = [], [], []
    for page, truth in zip(p, phases, strict=True):
        px, py = without_piston(page, truth, mask)
        mu, kappa = np.arctan2(py, px), np.hypot(px, py)
        symbols = (np.rint(truth * (LEVELS / (2 * np.pi))).astype(np.int64) % LEVELS).astype(np.uint8)
        rates.append(achievable_rate(mu, kappa, symbols, LEVELS))
        claims.append(own_information(kappa, LEVELS))
        errors.append(np.angle(np.exp(1j * (mu - truth))) ** 2)
    means = {"air_map": np.mean(rates, 0), "own_mi_map": np.mean(claims, 0), "error_map": np.sqrt(np.mean(errors, 0))}
    return {name: np.where(mask, np.nan, value).astype(np.float32) for name, value in means.items()}


def _curves(folder: Path) -> dict[str, NDArray[np.float64]]:
    events = EventAccumulator(str(folder))
    events.Reload()
    known = events.Tags()["scalars"]

    def scalars(name: str) -> NDArray[np.float64]:
        seen = [(event.step, event.value) for event in events.Scalars(name)] if name in known else []
        return np.array(seen, dtype=np.float64).reshape(-1, 2)

    return {
        "training_curve": scalars("train_air"),
        "validation_curve": scalars("val_air"),
        "angles": scalars("angle_deg"),
    }
