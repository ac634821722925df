"""The bundle of a finished training run, proven against torch with the runtime's own decoder."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from lightpage.errors import InvalidInputError
from lightpage.export.batched import files_for_batches
from lightpage.export.graph import FRAME_INPUTS, DecoderGraph, FieldGraph
from lightpage.export.half import LARGEST_DEVIATION, check_deviation, in_half, rounded
from lightpage.export.onnx_files import decoder_onnx, field_onnx, twin_onnx
from lightpage.export.parity import check_parity
from lightpage.export.proof import check_new, proven
from lightpage.export.run_graph import golden_of, graph_of
from lightpage.progress import Progress, note
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import narrow
from lightpage.runtime.model.bundle.bundle import Bundle, npz, write_bundle
from lightpage.runtime.model.bundle.manifest import (
    DECODER,
    FIELD,
    FLOAT16,
    FLOAT32,
    GOLDEN,
    PILOTS,
    TWIN,
    Manifest,
    Precision,
    Provenance,
    version_of,
)
from lightpage.runtime.model.decoding.golden import GOLDEN_TOLERANCE
from lightpage.runtime.model.execution.page_graph import PAGE_INPUTS
from lightpage.runtime.model.execution.session import open_session
from lightpage.train.models.twin import RayTwin
from lightpage.train.published.training import PublishedChoices
from lightpage.train.runs import GOLDEN as RUN_GOLDEN
from lightpage.train.runs import REFERENCES, load_arrays, load_run

PILOT_ARRAYS = {"mask": "pilots", "phases": "pilot_phases"}
"""Arrays of the bundle's pilots by their name in the run; phases only where the device has fixed ones of its own."""


def export_run(
    folder: Path,
    out: Path,
    name: str | None = None,
    version: str | None = None,
    progress: Progress = lambda step, share: None,
    recording: Path | None = None,
    precision: Precision = FLOAT32,
    *,
    batches: bool = False,
) -> tuple[Bundle, float]:
    """Write the bundle of a run.

    Args:
        folder: folder of the run.
        out: new bundle.
        name, version: name and version of the bundle.
        progress: function that takes every step.
        recording: recording with pages that the run has not seen, to choose the code of user bytes by; no code without.
        precision: precision of network and waves, one of `PRECISIONS`.
        batches: whether the bundle holds the decoder for many pages too. It is left out, with a warning, for a device
            that it cannot decode, and where it does not say what the decoder for one page says.

    Returns:
        The bundle as opened again, and the relative error of p against torch on the golden page.

    Raises:
        InvalidInputError: the run is unfinished, or of a published decoder, which has no half precision.
        RecordingError: the recording is of another device.
        BundleError: `version` is none, or the exported decoder does not say what torch says; nothing stays at `out`.
    """
    check_new(out, version)
    run = load_run(folder)
    if precision != FLOAT32 and isinstance(run.hyperparameters, PublishedChoices):
        raise InvalidInputError("--precision", f"{precision} for a published decoder", FLOAT32)
    profile, calibration = run.profile, run.calibration
    twin = RayTwin(profile)
    kept, golden = load_arrays(folder / REFERENCES), load_arrays(folder / RUN_GOLDEN)
    references, pair = (
        narrow(FramePair(arrays["in_phase"], arrays["quadrature"]), run.camera_bit_depth) for arrays in (kept, golden)
    )
    frame_dtype = pair.in_phase.dtype.name
    graph, defaults = graph_of(folder, run, references, twin)
    progress("ask torch", 0.0)
    limit, pair, expected = golden_of(graph, pair, defaults, run.camera_bit_depth)
    progress("decoder to ONNX", 0.2)
    decoder = decoder_onnx(graph, frame_dtype, profile.frame_shape, defaults)
    progress("ask ONNX Runtime", 0.6)
    checked = decoder
    if precision == FLOAT16:
        decoder, checked = in_half(decoder, PAGE_INPUTS), rounded(decoder, PAGE_INPUTS)
    session = open_session(checked, f"{out}: {DECODER}", once=precision == FLOAT16)
    (answer,) = session.run(["p"], dict(zip(FRAME_INPUTS, (pair.in_phase, pair.quadrature), strict=True)))
    if precision == FLOAT16:
        off = check_deviation(expected["p"], np.asarray(answer), str(out))
        note(f"half precision: p off by {off:.1e} of its length for 99% of the symbols, at most {LARGEST_DEVIATION:g}")
    error = check_parity(expected["p"], np.asarray(answer), str(out), GOLDEN_TOLERANCE[precision])
    name, created = name or profile.name, datetime.now(UTC)
    manifest = Manifest(
        name=name,
        version=version or version_of(name, created, decoder),
        created=created.isoformat(timespec="seconds"),
        profile=run.profile_toml,
        calibration=run.calibration_toml,
        camera_bit_depth=run.camera_bit_depth,
        frame_dtype="uint8" if frame_dtype == "uint8" else "uint16",
        metrics={"validation_air_bits_per_symbol": run.validation_air, "training_seconds": run.seconds},
        precision=precision,
        calibrated_pages=calibration.calibrated_pages,
        trained_pages=run.trained_pages,
        table_inputs=tuple(defaults),
        residual_output="residual" if "residual" in graph.outputs else None,
        residual_limit=limit,
        provenance=Provenance(**run.provenance),
    )
    field = {}
    if isinstance(graph, DecoderGraph):
        recovers = FieldGraph(profile, graph.recovery.reflections, graph.apart)
        field = {FIELD: field_onnx(recovers, frame_dtype, defaults)}
    files = {
        DECODER: decoder,
        TWIN: twin_onnx(twin),
        **field,
        GOLDEN: npz(in_phase=pair.in_phase, quadrature=pair.quadrature, p=expected["p"]),
        PILOTS: npz(**{name: kept[key] for name, key in PILOT_ARRAYS.items() if key in kept}),
    }
    if batches and isinstance(graph, DecoderGraph):
        progress("decoder for many pages to ONNX", 0.7)
        files |= files_for_batches(graph, frame_dtype, defaults)
    progress("load the bundle as the service does", 0.8)
    manifest, files = proven(out, manifest, files, recording, progress)
    write_bundle(out, manifest, files)
    return Bundle.open(out), error
