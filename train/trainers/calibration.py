"""Calibration of the device of a recording, in torch."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from lightpage.calibration import calibrate as registration
from lightpage.calibration.document import BlemishCounts, Calibration
from lightpage.calibration.known_pages import known_pages, without_blemishes
from lightpage.calibration.likelihood.device_fit import AFTER_REGISTRATION, DeviceFit
from lightpage.device.profile import Profile
from lightpage.progress import Progress, part
from lightpage.recording.pixels.blemishes import Blemishes
from lightpage.recording.reader import Recording
from lightpage.train.data.features import CPU
from lightpage.train.models.field import FieldRecovery, TorchFieldSolver
from lightpage.train.models.likelihood.estimator import PhaseEstimator
from lightpage.train.models.likelihood.torch_likelihood import TorchLikelihood
from lightpage.train.models.twin import RayTwin, TorchTwin


def calibrate_recording(
    recording: Recording,
    profile: Profile,
    pages: Sequence[int],
    progress: Progress,
    *,
    any_orientation: bool = False,
    compute: torch.device = CPU,
    near: Calibration | None = None,
) -> Calibration:
    """Calibrate with some pages of a recording.

    Args:
        recording: recording with known symbols.
        profile: nominal device.
        pages: numbers of the pages.
        progress: called at the beginning of each stage, and with its finished share.
        any_orientation: whether mirrored or turned cameras are accepted.
        compute: processor that recovers the light's field.
        near: earlier calibration of the same device, from which the fit starts; from nominal if left out.

    Raises:
        RecordingError: no symbols, no such page, or a recording of another profile.
        CalibrationError: nothing within the capture range, or near the earlier calibration, explains the frames.
    """
    recording.header.check_against(profile)
    twin = nominal_twin(profile)
    blemishes = Blemishes.of(recording.references())
    known = without_blemishes(known_pages(recording, profile, pages), blemishes)
    solver = TorchFieldSolver(FieldRecovery(profile).to(compute))
    device = twin, solver, profile, blemishes.references, known
    registering = part(progress, 0, AFTER_REGISTRATION)
    refining = part(progress, AFTER_REGISTRATION, 1)
    if near is None:
        registered = registration.calibrate(*device, registering, any_orientation=any_orientation)
    else:
        registered = registration.refine(*device, near.vector, near.turn_rad, registering, near.modulator, judged=False)
    hashes = [recording.page_hash(page) for page in pages]
    counts = BlemishCounts.of(blemishes)
    if registered.conditions is None:
        return Calibration.from_registered(registered, profile, hashes, blemishes=counts)
    fit = DeviceFit(
        TorchLikelihood(PhaseEstimator(profile, registered.parameters).eval()),
        twin,
        profile,
        blemishes.references,
        known,
        lambda share: refining("likelihood of all known pages", share),
        blemishes.gains,
    )
    refined, statistics = fit.refined(registered, registered.conditions)
    return Calibration.from_registered(refined, profile, hashes, statistics, counts)


def nominal_twin(profile: Profile) -> TorchTwin:
    """Return the ray tracer of a nominal device."""
    return TorchTwin(RayTwin(profile))
