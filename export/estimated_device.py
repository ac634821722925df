"""Everything by which an estimator reads the pages of a calibrated device: graphs, table and noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.document import Calibration
from lightpage.calibration.likelihood.measure import estimator_table
from lightpage.calibration.likelihood.table import PIXEL_GAINS, pilot_tensors
from lightpage.calibration.sampling_table import APART, SamplingTable
from lightpage.device.profile import Profile
from lightpage.errors import CalibrationError, InvalidInputError
from lightpage.export.estimator_graphs import estimator_files
from lightpage.page.correction import wrapped
from lightpage.page.pilots import Pilots
from lightpage.page.symbols import pilot_mask
from lightpage.progress import Progress
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.new_bundle import calibrated_pages
from lightpage.runtime.model.execution.estimator_graph import (
    DEVIATION_PRECISION,
    NO_DEVIATIONS,
    NOISE,
    EstimatorFiles,
    EstimatorGraph,
)
from lightpage.runtime.model.execution.table_graph import HeldTable
from lightpage.runtime.recalibration.estimator import check_counts
from lightpage.runtime.recalibration.flat_field import flat_field_of
from lightpage.runtime.recalibration.from_nominal import RecordedPages, recorded_pages, without_late_dust
from lightpage.runtime.recalibration.noise import MOST_STEPS, KnownPhases, deviation_prior_scale, measured_noise
from lightpage.train.models.likelihood.estimator import Estimate, PhaseEstimator
from lightpage.train.models.likelihood.torch_likelihood import TorchLikelihood
from lightpage.train.models.twin import RayTwin, TorchTwin
from lightpage.train.trainers.whole_run import own_pilots

MOST_START_ERROR = 1.05
"""Error of phases, over that after two fine steps, up to which they are as good. On the bench device it is 1.21 after
one fine step in bright light and 1.03 at 32 electrons. After a coarse step and a fine one it is 1.01 and 1.02."""


@dataclass(frozen=True)
class EstimatedDevice:
    """A calibrated device with its estimator.

    Attributes:
        device: calibrated device.
        twin: its ray tracer.
        estimator: estimator of its pages, in torch.
        graphs: the estimator's graphs.
        table: every tensor that the graphs take.
        optional: names of those that only some devices have.
        pages: known pages, with frames in the type that the bundle takes.
        pilot_mask: positions of the pilots, bool [ny, nx].
        pilot_phases: phases of the device's own fixed pilots, radians, 1-D; None if they are the profile's.
        flat_field_pages: hashes of further pages that the flat field is made of, see `hash_frames`.
    """

    device: CalibratedDevice
    twin: RayTwin
    estimator: PhaseEstimator
    graphs: EstimatorFiles
    table: SamplingTable
    optional: tuple[str, ...]
    pages: RecordedPages
    pilot_mask: NDArray[np.bool_]
    pilot_phases: NDArray[np.float32] | None
    flat_field_pages: tuple[str, ...]

    @property
    def steps(self) -> int:
        """Number of Gauss-Newton steps of a page."""
        return len(self.table[NOISE]) - 1

    @property
    def frame_dtype(self) -> str:
        """Numpy type of a frame's counts."""
        return self.pages.last_pair.in_phase.dtype.name


def estimated_device(
    calibration: Calibration, recording: Recording, profile: Profile, steps: int | None, progress: Progress
) -> EstimatedDevice:
    """Measure what an estimator needs of a calibrated device, and export its graphs.

    Args:
        calibration: calibration of the recording's device, with statistics of the counts.
        recording: recording with the pages of the calibration.
        profile: nominal device.
        steps: Gauss-Newton steps of a page; if left out, as many as gain information on the known pages.
        progress: called at the beginning of each part of the work, and with its finished share.

    Raises:
        CalibrationError: the calibration has no statistics, or belongs to other pages or references.
        InvalidInputError: `steps` is not within 1 and `MOST_STEPS`.
        ProfileError: the calibration belongs to another profile.
        RecordingError: the recording belongs to another device.
    """
    if steps is not None and not 1 <= steps <= MOST_STEPS:
        raise InvalidInputError("steps", steps, f"1 to {MOST_STEPS}")
    calibration.check_profile(profile)
    recording.header.check_against(profile)
    if (statistics := calibration.statistics) is None:
        raise CalibrationError("calibration: statistics", "none", "statistics of the counts: calibrate anew")
    used = calibrated_pages(calibration, recording)
    recorded = recorded_pages(recording, profile, used)
    device = calibration.device(profile, recorded.blemishes.references)
    twin = RayTwin(profile)
    estimator = PhaseEstimator(profile, device.parameters).eval()
    likelihood = TorchLikelihood(estimator)
    recorded = without_late_dust(recorded, likelihood, TorchTwin(twin), device, calibration)
    pages = recorded.corrected
    blemishes = recorded.blemishes
    table = estimator_table(
        likelihood,
        TorchTwin(twin),
        device,
        pages,
        statistics,
        lambda share: progress("information of the symbols", share),
    )
    recorded_mask = recording.pilots()
    mask = pilot_mask(profile) if recorded_mask is None else recorded_mask
    own = own_pilots(recording, profile, mask, [*range(recording.pages)])
    table |= pilot_tensors(_pilots(device, mask, own))
    table[NOISE] = np.tile(np.array([1, 0], np.float32), (MOST_STEPS + 1, 1))
    table[DEVIATION_PRECISION] = NO_DEVIATIONS
    table[PIXEL_GAINS] = blemishes.unit_gains  # the known pages have been corrected
    optional = (*device.apart_inputs, PIXEL_GAINS)
    estimator.coarse_start = coarse_start_pays(estimator, table, KnownPhases.of(pages[0], device), mask)
    progress("graphs to ONNX", 0.0)
    graphs = estimator_files(estimator, pages[0].pair.in_phase.dtype.name, optional, table)
    progress("noise of the known pages", 0.0)
    graph = EstimatorGraph(graphs, HeldTable(table), "estimator", None)
    known = [KnownPhases.of(page, device) for page in pages]
    check_counts(graph, known[0], mask, f"recording {recording.path}, page {used[0]}")
    table |= measured_noise(graph, known, mask, deviation_prior_scale(profile, statistics), steps)
    table[PIXEL_GAINS] = blemishes.gains
    graph = EstimatorGraph(graphs, HeldTable(table), "estimator", None)  # of as many steps as pay
    flat = flat_field_of(graph, recording, device, used, mask, lambda share: progress("flat field", share))
    table |= flat.table
    return EstimatedDevice(device, twin, estimator, graphs, table, optional, recorded, mask, own, flat.hashes)


def coarse_start_pays(
    estimator: PhaseEstimator, table: SamplingTable, known: KnownPhases, mask: NDArray[np.bool_]
) -> bool:
    """Return whether the first step should predict light coarsely.

    It should where a known page needs a second step even after a fine one, and the second step mends a coarse one.
    """
    tensors = {name: torch.from_numpy(np.array(value, order="C")) for name, value in table.items()}
    feeds = {name: torch.from_numpy(np.array(value)) for name, value in known.feeds(mask).items()}
    frames = feeds.pop("in_phase"), feeds.pop("quadrature")
    tensors |= feeds
    noise = tensors[NOISE][0]
    with torch.no_grad():
        operators = estimator.operators(tensors)
        cameras = estimator.recovery.cameras(*(tensors[name] for name in APART if name in tensors))
        first, page, _ = estimator.first(operators, tensors, noise, *frames)

        def after_step(estimate: Estimate, *, coarse: bool = False) -> Estimate:
            likelihood = estimator.likelihood(operators, tensors, page, estimate, cameras, coarse=coarse)
            return estimator.advanced(tensors, page, estimate, likelihood, noise, start=True)[0]

        def error(estimate: Estimate) -> float:
            phases = torch.atan2(estimate.p[1], estimate.p[0]).numpy().astype(np.float64)
            return float(np.median(np.abs(wrapped(phases - known.phases))))

        one_fine = after_step(first)
        largest = MOST_START_ERROR * error(after_step(one_fine))
        return error(one_fine) > largest >= error(after_step(after_step(first, coarse=True)))


def _pilots(device: CalibratedDevice, mask: NDArray[np.bool_], own: NDArray[np.float32] | None) -> Pilots:
    """Pilots of the device's pages with 256 levels."""
    if own is not None:
        return Pilots(mask, device.modulation.phase(own.astype(np.float64)))
    return Pilots.of_profile(device.profile, device.modulation.page_levels(256), mask)
