"""Export of a bundle from a calibration alone: the fitted waves estimate its pages, without a training run."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from lightpage.calibration.document import Calibration
from lightpage.device.profile import Profile
from lightpage.export.estimated_device import EstimatedDevice, estimated_device
from lightpage.export.estimator_graphs import WholeGraph, whole_onnx, with_constants_of
from lightpage.export.graph import FieldGraph
from lightpage.export.onnx_files import field_onnx, twin_onnx
from lightpage.export.parity import check_parity
from lightpage.export.proof import check_new, proven
from lightpage.export.run_graph import golden_of
from lightpage.metrics.provenance import command, commit
from lightpage.progress import Progress
from lightpage.recording.reader import Recording
from lightpage.runtime.model.bundle.bundle import Bundle, npz, write_bundle
from lightpage.runtime.model.bundle.manifest import (
    DECODER,
    EARLY,
    FIELD,
    FIRST,
    GOLDEN,
    OPERATORS,
    PILOTS,
    STEP,
    TWIN,
    Manifest,
    Provenance,
    version_of,
)
from lightpage.runtime.model.execution.estimator_graph import CHI_SQUARE
from lightpage.runtime.model.execution.session import open_session
from lightpage.runtime.model.execution.table_graph import GraphFile
from lightpage.train.models.presets import REFLECTIONS


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
        calibration, profile, steps: see `estimated_device`.
        recording: recording with the calibration's pages. Other pages with known symbols choose the code of user
            bytes.
        out: path of the new bundle.
        name: name of the bundle; the profile's if left out.
        version: version of the bundle; made of name, time and content if left out.
        progress: see `estimated_device`.

    Returns:
        The bundle as opened again, and the relative error of p against torch on the golden page.

    Raises:
        CalibrationError, InvalidInputError, ProfileError, RecordingError: see `estimated_device`.
        BundleError: `out` exists, `version` is malformed, or the graphs do not compute what torch computes. Nothing
            is left at `out` then.
    """
    check_new(out, version)
    estimated = estimated_device(calibration, recording, profile, steps, progress)
    table = estimated.table
    bits = recording.bit_depth
    progress("ask torch", 0.7)
    whole = WholeGraph(estimated.estimator, estimated.optional, estimated.steps).eval()
    defaults = {name: np.asarray(table[name]) for name in whole.table_inputs}
    limit, pair, expected = golden_of(whole, estimated.pages.last_pair, defaults, bits, CHI_SQUARE)
    decoder = whole_onnx(estimated.graphs, estimated.steps, table)
    progress("ask ONNX Runtime", 0.8)
    once = open_session(decoder, f"{out}: {DECODER}", once=True)
    (answer,) = once.run(["p"], {"in_phase": pair.in_phase, "quadrature": pair.quadrature})
    error = check_parity(expected["p"], np.asarray(answer), str(out))
    name = name or profile.name
    created = datetime.now(UTC)
    manifest = Manifest(
        name=name,
        version=version or version_of(name, created, decoder),
        created=created.isoformat(timespec="seconds"),
        profile=profile.to_toml(),
        calibration=calibration.to_toml(),
        camera_bit_depth=bits,
        frame_dtype="uint8" if estimated.frame_dtype == "uint8" else "uint16",
        calibrated_pages=(*calibration.calibrated_pages, *estimated.flat_field_pages),
        table_inputs=tuple(sorted(GraphFile(decoder, str(out)).table_inputs)),
        residual_output=CHI_SQUARE,
        residual_limit=limit,
        provenance=Provenance(command=command(), commit=commit()),
    )
    golden = npz(in_phase=pair.in_phase, quadrature=pair.quadrature, p=expected["p"])
    progress("load the bundle as the service does", 0.9)
    manifest, files = proven(out, manifest, _files(estimated, decoder, golden), recording.path, progress)
    write_bundle(out, manifest, files)
    return Bundle.open(out), error


def _files(estimated: EstimatedDevice, decoder: bytes, golden: bytes) -> dict[str, bytes]:
    """Contents of the bundle's files, by name."""
    device = estimated.device
    mask = estimated.pilot_mask
    own = estimated.pilot_phases
    graphs = estimated.graphs
    field = FieldGraph(device.profile, REFLECTIONS, device.apart_inputs)
    tensors = {name: np.asarray(estimated.table[name]) for name in field.table_inputs}
    return {
        DECODER: decoder,
        OPERATORS: with_constants_of(decoder, graphs.operators),
        FIRST: with_constants_of(decoder, graphs.first),
        EARLY: with_constants_of(decoder, graphs.early),
        STEP: with_constants_of(decoder, graphs.step),
        TWIN: twin_onnx(estimated.twin),
        FIELD: field_onnx(field, estimated.frame_dtype, tensors),
        GOLDEN: golden,
        PILOTS: npz(mask=mask) if own is None else npz(mask=mask, phases=own),
    }
