"""Calibrates a device of a bundle's profile with the bundle's graphs, and writes its own bundle, without torch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.calibrate import KnownPage, calibrate
from lightpage.calibration.document import BlemishCounts, Calibration
from lightpage.calibration.known_pages import known_pages, without_blemishes
from lightpage.calibration.likelihood.device_fit import DeviceFit
from lightpage.calibration.likelihood.table import FLAT_FIELD, PIXEL_GAINS
from lightpage.calibration.sampling_table import apart_inputs
from lightpage.errors import BundleError, CalibrationError, InvalidInputError
from lightpage.progress import Progress, warn
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import narrow, page_hashes
from lightpage.recording.pixels.blemishes import UNIT_GAIN, Blemishes
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.coded_pages import choose_code
from lightpage.runtime.archives.recordings.evaluation import check_recording, pilots_of
from lightpage.runtime.model.bundle.bundle import Bundle, npz, residual_limit, write_bundle
from lightpage.runtime.model.bundle.manifest import GOLDEN, Manifest, Provenance, version_of
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.runtime.model.execution.estimator_graph import EstimatorGraph
from lightpage.runtime.model.execution.twin import OnnxTwin
from lightpage.runtime.recalibration.estimator import GraphLikelihood, check_counts, measured_table
from lightpage.runtime.recalibration.noise import KnownPhases
from lightpage.runtime.recalibration.recalibration import golden_page, refitted_bundle
from lightpage.runtime.recalibration.refit import traced

MOST_PAGES = 4
"""Largest number of known pages on which information and noise are measured."""


class OtherGraphsWantedError(CalibrationError):
    """A device needs tensors that the graphs of a bundle do not take."""


def check_graphs(decoder: Decoder, recording: Recording) -> None:
    """Check that the graphs of a bundle can calibrate the device of a recording.

    Raises:
        BundleError: the bundle's decoder is a network.
        InvalidInputError: the recording has pilots at other places than the bundle.
        RecordingError, ProfileError: another profile, frame shape or bit depth.
    """
    bundle = decoder.bundle
    if not isinstance(decoder.graph, EstimatorGraph):
        raise BundleError(f"{bundle.subject}", "a network, trained for one device", "a bundle of a calibration")
    check_recording(decoder, recording)
    mask = bundle.pilot_mask
    symbols = recording.symbols(0)
    written = bundle.written_pilots(recording.levels)
    if not np.array_equal(pilots_of(decoder, recording), mask):
        got = "other places"
    elif symbols is not None and not np.array_equal(symbols[mask], written):
        got = "other symbols"
    else:
        return
    expected = f"those of {bundle.subject}; other ones need a bundle of their own (--graphs none)"
    raise InvalidInputError(f"recording {recording.path}: pilots", got, expected)


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
    blemishes, known = _known(recording, decoder, pages)
    twin = OnnxTwin(decoder.bundle)
    device = twin, decoder.field_solver, profile, blemishes.references, known
    registered = calibrate(*device, progress, any_orientation=any_orientation)
    lacking = {*apart_inputs(registered.parameters)} - decoder.graph.ports.keys()
    if lacking or registered.conditions is None:
        got = "cameras that see different planes, which the graphs do not allow for"
        expected = "graphs of this device (lightpage calibrate --graphs none)"
        raise OtherGraphsWantedError(f"{decoder.bundle.subject}: graphs", got, expected)
    likelihood = GraphLikelihood(_neutral(decoder))
    fit = DeviceFit(
        likelihood,
        twin,
        profile,
        blemishes.references,
        known,
        lambda share: progress("likelihood of all known pages", share),
    )
    refined, statistics = fit.refined(registered, registered.conditions)
    hashes = [recording.page_hash(page) for page in pages]
    return Calibration.from_registered(refined, profile, hashes, statistics, BlemishCounts.of(blemishes))


def bundle_by_graphs(
    decoder: Decoder,
    calibration: Calibration,
    recording: Recording,
    out: Path,
    name: str | None = None,
    version: str | None = None,
    progress: Progress = lambda step, share: None,
) -> Bundle:
    """Write the bundle of a calibrated device with the graphs of another bundle of its profile.

    Args:
        decoder: decoder of the other bundle; see `check_graphs`.
        calibration: calibration of the recording's device, with statistics of the counts.
        recording: recording with the pages of the calibration. Other pages with known symbols choose the code of user
            bytes.
        out: new path, a zip where it ends in .zip.
        name: name of the bundle; the profile's if left out.
        version: its version; its name, the time and a hash if left out.
        progress: called at the beginning of each step, and with its finished share.

    Raises:
        CalibrationError: the calibration has no statistics, or belongs to other pages or references.
        BundleError: `version` is malformed, or `out` cannot be written.
    """
    profile = decoder.bundle.profile
    calibration.check_profile(profile)
    if (statistics := calibration.statistics) is None:
        raise CalibrationError("calibration: statistics", "none", "statistics of the counts: calibrate anew")
    used = calibrated_pages(calibration, recording)
    blemishes, known = _known(recording, decoder, used)
    device = calibration.device(profile, blemishes.references)
    graph = _neutral(decoder)
    mask = decoder.bundle.pilot_mask
    twin = OnnxTwin(decoder.bundle)
    measured = measured_table(
        GraphLikelihood(graph), twin, device, known, statistics, mask, lambda share: progress("noise", 0.6 * share)
    )
    result = traced(decoder, twin, blemishes.references, calibration, gains=_gains(decoder, blemishes))
    result = replace(result, table={**result.table, **measured})
    fitted = refitted_bundle(decoder.bundle, result)
    new = decoder.of_bundle(fitted)
    assert isinstance(new.graph, EstimatorGraph)  # as that of `decoder`
    first = new.graph.with_table(_without_gains(new.graph, blemishes))
    check_counts(first, KnownPhases.of(known[0], device), mask, f"recording {recording.path}, page {used[0]}")
    progress("choose the code of user bytes", 0.7)
    pair = narrow(recording.frames(used[-1]), recording.bit_depth)
    swapped = FramePair(pair.quadrature, pair.in_phase)
    created = datetime.now(UTC)
    name = name or profile.name
    manifest = fitted.manifest.model_copy(
        update={
            "name": name,
            "version": version or version_of(name, created, calibration.to_toml().encode()),
            "created": created.isoformat(timespec="seconds"),
            "metrics": {},
            "calibrated_pages": calibration.calibrated_pages,
            "residual_limit": residual_limit(
                new.infer(pair, doubtful=True).residual, new.infer(swapped, doubtful=True).residual
            ),
            "code": None,
            "provenance": Provenance(command=f"calibrated with the graphs of {decoder.version}"),
        }
    )
    new = decoder.of_bundle(replace(fitted, manifest=manifest))
    manifest = _with_code(new, recording, manifest)
    golden, p = golden_page(new, pair)
    progress("write the bundle", 0.9)
    files = {**fitted.files, GOLDEN: npz(in_phase=golden.in_phase, quadrature=golden.quadrature, p=p)}
    write_bundle(out, manifest, files)
    progress("done", 1.0)
    return Bundle.open(out)


def calibrated_pages(calibration: Calibration, recording: Recording) -> list[int]:
    """Return the numbers of the last `MOST_PAGES` pages of a recording that belong to a calibration.

    Raises:
        CalibrationError: the recording has none of the calibration's pages.
    """
    wanted = set(calibration.calibrated_pages)
    known = [page for page in range(recording.pages) if not wanted.isdisjoint(page_hashes(recording.frames(page)))]
    if not known:
        expected = "the recording that the calibration was made of, or a calibration by pages of this one"
        raise CalibrationError(f"recording {recording.path}", "none of the calibration's pages", expected)
    if len(known) == 1:
        warn(
            "statistics of one known page only: with two, bright pages are read better (lightpage calibrate --pages 2)"
        )
    return known[-MOST_PAGES:]


def _with_code(decoder: Decoder, recording: Recording, manifest: Manifest) -> Manifest:
    """Return the manifest with a code of user bytes, where the recording's pages allow one."""
    try:
        choice, _ = choose_code(decoder, recording, tracker_for(decoder))
    except InvalidInputError as lacking:
        warn(f"no code for user bytes: {lacking}")
        return manifest
    return manifest.model_copy(update={"code": choice.code.to_toml()})


def _known(recording: Recording, decoder: Decoder, pages: Sequence[int]) -> tuple[Blemishes, list[KnownPage]]:
    """Return the blemishes of a recording's cameras, and its known pages without them."""
    bits = recording.bit_depth
    references = narrow(recording.references(), bits)
    read = known_pages(recording, decoder.bundle.profile, pages)
    recorded = [KnownPage(narrow(page.pair, bits), page.symbols) for page in read]
    if PIXEL_GAINS not in decoder.graph.ports:
        return Blemishes(np.full((2, *references.in_phase.shape), UNIT_GAIN, np.uint8), references), recorded
    blemishes = Blemishes.of(references)
    return blemishes, without_blemishes(recorded, blemishes)


def _gains(decoder: Decoder, blemishes: Blemishes) -> NDArray[np.uint8] | None:
    """Return the gains of the pixels, where the graph takes them."""
    return blemishes.gains if PIXEL_GAINS in decoder.graph.ports else None


def _without_gains(graph: EstimatorGraph, blemishes: Blemishes) -> dict[str, NDArray[np.uint8]]:
    """Return unit gains for frames that have been corrected, where the graph takes gains."""
    return {PIXEL_GAINS: np.full_like(blemishes.gains, UNIT_GAIN)} if PIXEL_GAINS in graph.ports else {}


def _neutral(decoder: Decoder) -> EstimatorGraph:
    """Return the graph without the flat field and the gains of its own device."""
    graph = decoder.graph
    assert isinstance(graph, EstimatorGraph)  # see `check_graphs`
    values = {FLAT_FIELD: 0, PIXEL_GAINS: UNIT_GAIN}
    held = {name: value for name, value in values.items() if name in graph.ports}
    return graph.with_table({name: np.full_like(graph.value(name), value) for name, value in held.items()})
