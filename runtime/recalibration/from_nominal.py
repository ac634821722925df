"""Calibrates a device from nominal with the graphs of a bundle of its profile, without torch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lightpage.calibration.calibrate import KnownPage, Registered, calibrate
from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.document import BlemishCounts, Calibration
from lightpage.calibration.interfaces import Twin
from lightpage.calibration.known_pages import known_pages, without_blemishes
from lightpage.calibration.likelihood.device_fit import AFTER_REGISTRATION, DeviceFit
from lightpage.calibration.likelihood.interfaces import PageLikelihood
from lightpage.calibration.likelihood.late_dust import late_dust
from lightpage.calibration.likelihood.table import FLAT_FIELD, PIXEL_GAINS
from lightpage.calibration.sampling_table import apart_inputs
from lightpage.device.profile import Profile
from lightpage.errors import CalibrationError
from lightpage.progress import Progress, part
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import narrow
from lightpage.recording.pixels.blemishes import Blemishes
from lightpage.recording.reader import Recording
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.execution.estimator_graph import EstimatorGraph
from lightpage.runtime.model.execution.twin import OnnxTwin
from lightpage.runtime.recalibration.estimator import GraphLikelihood


class OtherGraphsWantedError(CalibrationError):
    """A device needs tensors that the graphs of a bundle do not take."""


class RecordedPages(NamedTuple):
    """Known pages of a recording.

    Attributes:
        blemishes: blemishes of the cameras.
        corrected: pages without them.
        last_pair: frames of the last page with them.
    """

    blemishes: Blemishes
    corrected: list[KnownPage]
    last_pair: FramePair


def calibrate_by_graphs(
    decoder: Decoder, recording: Recording, pages: Sequence[int], progress: Progress, *, any_orientation: bool = False
) -> Calibration:
    """Calibrate a device from nominal with the graphs of a bundle of its profile.

    Args:
        decoder: decoder of any device of the profile; see `check_graphs`.
        recording: recording of the device, with known symbols.
        pages: numbers of the pages.
        progress: called at the beginning of each stage, and with its finished share.
        any_orientation: whether mirrored or turned cameras are accepted.

    Raises:
        RecordingError: no symbols, or no such page.
        CalibrationError: nothing within the capture range explains the frames.
        OtherGraphsWantedError: the cameras see different planes, which the graphs do not allow for.
    """
    profile = decoder.bundle.profile
    blemishes, known, _ = recorded_pages(recording, profile, pages)
    twin = OnnxTwin(decoder.bundle)
    device = twin, decoder.field_solver, profile, blemishes.references, known
    registered = calibrate(*device, part(progress, 0, AFTER_REGISTRATION), any_orientation=any_orientation)
    _check_planes(decoder, registered)
    assert registered.conditions is not None  # its waves were fitted
    refining = part(progress, AFTER_REGISTRATION, 1)
    likelihood = GraphLikelihood(neutral_graph(decoder, blemishes))
    fit = DeviceFit(
        likelihood,
        twin,
        profile,
        blemishes.references,
        known,
        lambda share: refining("likelihood of all known pages", share),
        blemishes.gains,
    )
    refined, statistics = fit.refined(registered, registered.conditions)
    _check_planes(decoder, refined)
    hashes = [recording.page_hash(page) for page in pages]
    return Calibration.from_registered(refined, profile, hashes, statistics, BlemishCounts.of(blemishes))


def _check_planes(decoder: Decoder, registered: Registered) -> None:
    """Check that graphs allow for the planes that the cameras see.

    Raises:
        OtherGraphsWantedError: the planes differ, and the graphs take no tensors of that.
    """
    if {*apart_inputs(registered.parameters)} - decoder.graph.ports.keys():
        got = "cameras that see different planes, which the graphs do not allow for"
        expected = "graphs of this device (lightpage calibrate --graphs none)"
        raise OtherGraphsWantedError(f"{decoder.bundle.subject}: graphs", got, expected)


def recorded_pages(recording: Recording, profile: Profile, pages: Sequence[int]) -> RecordedPages:
    """Read known pages of a recording, with counts in the type that graphs take.

    Raises:
        FrameError, RecordingError: see `known_pages`.
    """
    bits = recording.bit_depth
    blemishes = Blemishes.of(narrow(recording.references(), bits))
    read = [KnownPage(narrow(page.pair, bits), page.symbols) for page in known_pages(recording, profile, pages)]
    return RecordedPages(blemishes, without_blemishes(read, blemishes), read[-1].pair)


def without_late_dust(
    pages: RecordedPages, likelihood: PageLikelihood, twin: Twin, device: CalibratedDevice, calibration: Calibration
) -> RecordedPages:
    """Return known pages without the shadows of dust that the references do not show, if the calibration names such.

    Args:
        pages: known pages.
        likelihood: likelihood of the device's pages.
        twin: ray tracer of the nominal device.
        device: calibrated device.
        calibration: its calibration.
    """
    if calibration.statistics is None or not calibration.behind_late_dust:
        return pages
    late = late_dust(likelihood, twin, device, pages.corrected, calibration.statistics)
    return pages._replace(blemishes=pages.blemishes.joined(late), corrected=without_blemishes(pages.corrected, late))


def neutral_graph(decoder: Decoder, blemishes: Blemishes) -> EstimatorGraph:
    """Return the graph without the flat field of its own device, for frames without blemishes."""
    graph = decoder.graph
    assert isinstance(graph, EstimatorGraph)  # that of a bundle of a calibration
    no_flat_field = np.zeros(decoder.bundle.profile.page_shape, np.float32)
    return graph.with_table({FLAT_FIELD: no_flat_field, PIXEL_GAINS: blemishes.unit_gains})
