"""The bundle of a calibration alone: pages are estimated by the fitted waves, without a training run."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.calibrate import KnownPage
from lightpage.calibration.document import Calibration
from lightpage.calibration.known_pages import known_pages
from lightpage.calibration.likelihood.measure import estimator_table
from lightpage.calibration.likelihood.table import pilot_tensors
from lightpage.device.profile import Profile
from lightpage.errors import CalibrationError
from lightpage.export.estimator_graphs import WholeGraph, estimator_files, whole_onnx
from lightpage.export.graph import FieldGraph
from lightpage.export.onnx_files import field_onnx, twin_onnx
from lightpage.export.parity import check_parity
from lightpage.export.proof import check_new, proven, version_of
from lightpage.export.run_graph import golden_of
from lightpage.metrics.provenance import command, commit
from lightpage.page.pilots import Pilots
from lightpage.page.symbols import pilot_mask
from lightpage.progress import Progress, warn
from lightpage.recording.layout import narrow
from lightpage.recording.reader import Recording
from lightpage.runtime.model.bundle.bundle import Bundle, npz, write_bundle
from lightpage.runtime.model.bundle.manifest import (
    DECODER,
    ESTIMATOR_FILES,
    FIELD,
    GOLDEN,
    PILOTS,
    TWIN,
    Manifest,
    Provenance,
)
from lightpage.runtime.model.execution.estimator_graph import NOISE, EstimatorGraph
from lightpage.runtime.model.execution.session import open_session
from lightpage.runtime.model.execution.table_graph import GraphFile, HeldTable
from lightpage.runtime.recalibration.noise import MOST_STEPS, measured_noise
from lightpage.train.models.likelihood.estimator import PhaseEstimator
from lightpage.train.models.likelihood.torch_likelihood import TorchLikelihood
from lightpage.train.models.presets import REFLECTIONS
from lightpage.train.models.twin import RayTwin, TorchTwin
from lightpage.train.trainers.whole_run import own_pilots

MOST_PAGES = 4
"""Known pages by which information and noise are measured, at most."""


def export_calibration(
    calibration: Calibration,
    recording: Recording,
    profile: Profile,
    out: Path,
    name: str | None = None,
    version: str | None = None,
    progress: Progress = lambda step, share: None,
    steps: int | None = None,
) -> tuple[Bundle, float]:
    """Write the bundle of a calibration.

    Args:
        calibration: calibration of the recording's device, with its statistics.
        recording: recording with the pages that it was made of; other pages with known symbols choose the code of user
            bytes.
        profile: nominal device.
        out: new bundle.
        name, version: name and version of the bundle.
        progress: function that takes every step.
        steps: Gauss-Newton steps of a page; as many as gain information on the known pages if left out.

    Returns:
        The bundle as opened again, and the relative error of p against torch on the golden page.

    Raises:
        CalibrationError: a calibration without statistics, or of other pages.
        RecordingError: the recording is of another device.
        BundleError: `version` is none, or the graphs do not say what torch says; nothing stays at `out`.
    """
    check_new(out, version)
    calibration.check_profile(profile)
    recording.header.check_against(profile)
    if (statistics := calibration.statistics) is None:
        raise CalibrationError("calibration: statistics", "none", "those of the counts: calibrate anew")
    used = pages_of(calibration, recording)
    pages, bits = known_pages(recording, profile, used), recording.bit_depth
    references = narrow(recording.references(), bits)
    pages = [KnownPage(narrow(page.pair, bits), page.symbols) for page in pages]
    device = calibration.device(profile, references)
    twin = RayTwin(profile)
    estimator = PhaseEstimator(profile, device.parameters).eval()
    progress("information of the symbols", 0.0)
    table = estimator_table(
        TorchLikelihood(estimator),
        TorchTwin(twin),
        device,
        pages,
        statistics,
        lambda share: progress("information of the symbols", 0.4 * share),
    )
    mask = recording.pilots()
    mask = pilot_mask(profile) if mask is None else mask
    own = own_pilots(recording, profile, mask, used)
    table |= pilot_tensors(_pilots(calibration, profile, mask, own))
    table[NOISE] = np.tile(np.array([1, 0], np.float32), (MOST_STEPS + 1, 1))
    progress("graphs to ONNX", 0.4)
    frame_dtype = pages[0].pair.in_phase.dtype.name
    graphs = estimator_files(estimator, frame_dtype, device.apart_inputs, table)
    progress("noise of the known pages", 0.6)
    graph = EstimatorGraph(graphs, HeldTable(table), str(out), (), None)
    table[NOISE] = measured_noise(
        graph, [(page.pair, np.angle(page.light(device.modulation))) for page in pages], mask, steps
    )
    del graph
    progress("ask torch", 0.7)
    whole = WholeGraph(estimator, device.apart_inputs, len(table[NOISE]) - 1).eval()
    defaults = {name: np.asarray(table[name]) for name in whole.table_inputs}
    limit, pair, expected = golden_of(whole, pages[-1].pair, defaults, bits)
    decoder = whole_onnx(graphs, len(table[NOISE]) - 1, table)
    progress("ask ONNX Runtime", 0.8)
    once = open_session(decoder, f"{out}: {DECODER}", once=True)
    (answer,) = once.run(["p"], {"in_phase": pair.in_phase, "quadrature": pair.quadrature})
    error = check_parity(expected["p"], np.asarray(answer), str(out))
    name, created = name or profile.name, datetime.now(UTC)
    manifest = Manifest(
        name=name,
        version=version or version_of(name, created, decoder),
        created=created.isoformat(timespec="seconds"),
        profile=profile.to_toml(),
        calibration=calibration.to_toml(),
        camera_bit_depth=bits,
        frame_dtype="uint8" if frame_dtype == "uint8" else "uint16",
        calibrated_pages=calibration.calibrated_pages,
        table_inputs=tuple(sorted(GraphFile(decoder, str(out)).table_inputs)),
        residual_output="residual",
        residual_limit=limit,
        provenance=Provenance(command=command(), commit=commit()),
    )
    field = FieldGraph(profile, REFLECTIONS, device.apart_inputs)
    files = {
        DECODER: decoder,
        **dict(zip(ESTIMATOR_FILES, graphs, strict=True)),
        TWIN: twin_onnx(twin),
        FIELD: field_onnx(field, frame_dtype, {name: np.asarray(table[name]) for name in field.table_inputs}),
        GOLDEN: npz(in_phase=pair.in_phase, quadrature=pair.quadrature, p=expected["p"]),
        PILOTS: npz(mask=mask) if own is None else npz(mask=mask, phases=own),
    }
    progress("load the bundle as the service does", 0.9)
    manifest, files = proven(out, manifest, files, recording.path, progress)
    write_bundle(out, manifest, files)
    return Bundle.open(out), error


def pages_of(calibration: Calibration, recording: Recording) -> list[int]:
    """Numbers of the pages of a recording that a calibration was made of, the last ones.

    Raises:
        CalibrationError: none of them is there.
    """
    wanted = set(calibration.calibrated_pages)
    found = [page for page in range(recording.pages) if recording.page_hash(page) in wanted]
    if not found:
        expected = "the recording that the calibration was made of, or a calibration by pages of this one"
        raise CalibrationError(f"recording {recording.path}", "none of the calibration's pages", expected)
    if len(found) == 1:
        warn("statistics by one known page: two read more in bright light (lightpage calibrate --pages 2)")
    return found[-MOST_PAGES:]


def _pilots(
    calibration: Calibration, profile: Profile, mask: NDArray[np.bool_], own: NDArray[np.float32] | None
) -> Pilots:
    """Pilots of the device's pages of 256 levels."""
    modulation = calibration.modulator
    if own is not None:
        return Pilots(mask, modulation.phase(own.astype(np.float64)))
    return Pilots.of_profile(profile, modulation.page_levels(256), mask)
