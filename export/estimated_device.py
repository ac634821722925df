"""A calibrated device as an estimator reads its pages: graphs, table and noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.calibrate import KnownPage
from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.document import Calibration
from lightpage.calibration.known_pages import known_pages
from lightpage.calibration.likelihood.measure import estimator_table
from lightpage.calibration.likelihood.table import pilot_tensors
from lightpage.calibration.sampling_table import SamplingTable
from lightpage.device.profile import Profile
from lightpage.errors import CalibrationError
from lightpage.export.estimator_graphs import estimator_files
from lightpage.page.pilots import Pilots
from lightpage.page.symbols import pilot_mask
from lightpage.progress import Progress, warn
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import narrow
from lightpage.recording.reader import Recording
from lightpage.runtime.model.execution.estimator_graph import (
    DEVIATION_PRECISION,
    NO_DEVIATIONS,
    NOISE,
    EstimatorFiles,
    EstimatorGraph,
)
from lightpage.runtime.model.execution.table_graph import HeldTable
from lightpage.runtime.recalibration.estimator import KNOWN_CONCENTRATION
from lightpage.runtime.recalibration.noise import MOST_STEPS, measured_noise
from lightpage.train.models.likelihood.estimator import PhaseEstimator
from lightpage.train.models.likelihood.torch_likelihood import TorchLikelihood
from lightpage.train.models.twin import RayTwin, TorchTwin
from lightpage.train.trainers.whole_run import own_pilots
from lightpage.waves.grid import symbol_samples

MOST_PAGES = 4
"""Known pages by which information and noise are measured, at most."""
MOST_CHI_SQUARE = 2.0
"""Largest mean square of a known page's residuals over their variance, which is measured so that it is 1. A small
device's page has 5.5 with references at 0.9 times their exposure, 11 with mirrored ones, and 3.3 with ones that are 20
pixels away."""


@dataclass(frozen=True)
class EstimatedDevice:
    """A calibrated device with all that its pages are estimated by.

    Attributes:
        device: calibrated device.
        twin: its ray tracer.
        estimator: its estimator.
        graphs: the estimator's graphs.
        table: every tensor that they take.
        pages: known pages, in counts as the device's frames are kept.
        pilot_mask: places of the pilots, bool [ny, nx].
        pilot_phases: phases of the device's own fixed pilots, radians; None where they are the profile's.
    """

    device: CalibratedDevice
    twin: RayTwin
    estimator: PhaseEstimator
    graphs: EstimatorFiles
    table: SamplingTable
    pages: list[KnownPage]
    pilot_mask: NDArray[np.bool_]
    pilot_phases: NDArray[np.float32] | None

    @property
    def steps(self) -> int:
        """Number of Gauss-Newton steps of a page."""
        return len(self.table[NOISE]) - 1

    @property
    def frame_dtype(self) -> str:
        """Type of a frame's counts."""
        return self.pages[0].pair.in_phase.dtype.name


def estimated_device(
    calibration: Calibration, recording: Recording, profile: Profile, steps: int | None, progress: Progress
) -> EstimatedDevice:
    """Measure what an estimator needs of a calibrated device, and export its graphs.

    Args:
        calibration: calibration of the recording's device, with its statistics.
        recording: recording with the pages that it was made of.
        profile: nominal device.
        steps: Gauss-Newton steps of a page; as many as gain information on the known pages if left out.
        progress: function that takes every step.

    Raises:
        CalibrationError: a calibration without statistics, or of other pages or references.
        ProfileError: a calibration of another profile.
        RecordingError: the recording is of another device.
    """
    calibration.check_profile(profile)
    recording.header.check_against(profile)
    if (statistics := calibration.statistics) is None:
        raise CalibrationError("calibration: statistics", "none", "statistics of the counts: calibrate anew")
    used, bits = calibrated_pages(calibration, recording), recording.bit_depth
    pages = [KnownPage(narrow(page.pair, bits), page.symbols) for page in known_pages(recording, profile, used)]
    device = calibration.device(profile, narrow(recording.references(), bits))
    twin, estimator = RayTwin(profile), PhaseEstimator(profile, device.parameters).eval()
    what = "information of the symbols"
    table = estimator_table(
        TorchLikelihood(estimator), TorchTwin(twin), device, pages, statistics, lambda share: progress(what, share)
    )
    mask = recording.pilots()
    mask = pilot_mask(profile) if mask is None else mask
    own = own_pilots(recording, profile, mask, used)
    table |= pilot_tensors(_pilots(device, mask, own))
    table |= {NOISE: np.tile(np.array([1, 0], np.float32), (MOST_STEPS + 1, 1)), DEVIATION_PRECISION: NO_DEVIATIONS}
    progress("graphs to ONNX", 0.0)
    graphs = estimator_files(estimator, pages[0].pair.in_phase.dtype.name, device.apart_inputs, table)
    progress("noise of the known pages", 0.0)
    graph = EstimatorGraph(graphs, HeldTable(table), "estimator", None)
    known = [(page.pair, np.angle(page.light(device.modulation))) for page in pages]
    check_counts(graph, *known[0], f"recording {recording.path}, page {used[0]}")
    prior_scale = symbol_samples(profile) ** 2 * statistics.correlation
    table |= measured_noise(graph, known, mask, prior_scale, steps)
    return EstimatedDevice(device, twin, estimator, graphs, table, pages, mask, own)


def check_counts(graph: EstimatorGraph, pair: FramePair, phases: NDArray[np.float64], subject: str) -> None:
    """Check that a known page's counts scatter about the expected ones as the calibration's statistics say.

    Args:
        graph: graph of the calibrated device.
        pair: frames of a page that the calibration was made of.
        phases: phases of its light, radians [ny, nx].
        subject: name of the page, for the error.

    Raises:
        CalibrationError: they scatter more, as with other references than those of the calibration.
    """
    p = (KNOWN_CONCENTRATION * np.stack([np.cos(phases), np.sin(phases)])).astype(np.float32)
    page = graph.begun({"in_phase": pair.in_phase, "quadrature": pair.quadrature})
    nuisance = page["nuisance"]
    chi_square = np.inf
    for _ in range(MOST_STEPS):
        step = graph.derivatives(page, {}, p, nuisance, ("nuisance", "chi_square"))
        nuisance = step["nuisance"]
        chi_square = float(step["chi_square"])
    if not chi_square <= MOST_CHI_SQUARE:
        got = f"counts that scatter {chi_square:.3g} times as much as the calibration says"
        expected = f"at most {MOST_CHI_SQUARE:g} times; are these the calibration's references? Or calibrate anew"
        raise CalibrationError(subject, got, expected)


def calibrated_pages(calibration: Calibration, recording: Recording) -> list[int]:
    """Numbers of the pages of a recording that a calibration was made of, the last ones.

    Raises:
        CalibrationError: none of them is there.
    """
    wanted = set(calibration.calibrated_pages)
    known = [page for page in range(recording.pages) if recording.page_hash(page) in wanted]
    if not known:
        expected = "the recording that the calibration was made of, or a calibration by pages of this one"
        raise CalibrationError(f"recording {recording.path}", "none of the calibration's pages", expected)
    if len(known) == 1:
        warn("statistics by one known page: two read more in bright light (lightpage calibrate --pages 2)")
    return known[-MOST_PAGES:]


def _pilots(device: CalibratedDevice, mask: NDArray[np.bool_], own: NDArray[np.float32] | None) -> Pilots:
    """Pilots of the device's pages of 256 levels."""
    if own is not None:
        return Pilots(mask, device.modulation.phase(own.astype(np.float64)))
    return Pilots.of_profile(device.profile, device.modulation.page_levels(256), mask)
