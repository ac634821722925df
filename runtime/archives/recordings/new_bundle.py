"""Writes the bundle of a calibrated device with the graphs of another bundle of its profile, without torch."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from lightpage.calibration.document import Calibration
from lightpage.calibration.likelihood.table import FLAT_FIELD, PIXEL_GAINS, pilot_tensors
from lightpage.codec.code import parse_code
from lightpage.device.profile import Profile
from lightpage.errors import BundleError, CalibrationError, InvalidInputError, LightpageError, ProfileError
from lightpage.progress import Progress, note, warn
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import page_hashes
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.coded_pages import choose_code
from lightpage.runtime.archives.recordings.evaluation import check_recording, pilots_of
from lightpage.runtime.archives.recordings.reading import reading_of
from lightpage.runtime.model.bundle.bundle import Bundle, npz, residual_limit, write_bundle
from lightpage.runtime.model.bundle.manifest import GOLDEN, Manifest, Provenance, version_of
from lightpage.runtime.model.bundle.shipped import DEFAULT, bundle_path
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.runtime.model.execution.estimator_graph import EstimatorGraph
from lightpage.runtime.model.execution.twin import OnnxTwin
from lightpage.runtime.recalibration.estimator import GraphLikelihood, check_counts, measured_table
from lightpage.runtime.recalibration.flat_field import flat_field_of
from lightpage.runtime.recalibration.from_nominal import neutral_graph, recorded_pages, without_late_dust
from lightpage.runtime.recalibration.noise import KnownPhases
from lightpage.runtime.recalibration.recalibration import golden_page, refitted_bundle
from lightpage.runtime.recalibration.refit import traced

MOST_PAGES = 4
"""Largest number of known pages on which information and noise are measured."""


def check_graphs(decoder: Decoder, recording: Recording) -> None:
    """Check that the graphs of a bundle can calibrate the device of a recording.

    Raises:
        BundleError: the bundle's decoder is a network, or takes no gains of pixels, as those of earlier versions.
        InvalidInputError: the recording has pilots at other places than the bundle.
        RecordingError: another frame shape, page or bit depth.
    """
    bundle = decoder.bundle
    if not isinstance(decoder.graph, EstimatorGraph):
        raise BundleError(f"{bundle.subject}", "a network, trained for one device", "a bundle of a calibration")
    if not {PIXEL_GAINS, FLAT_FIELD} <= decoder.graph.ports.keys():
        got = "graphs that take no gains of pixels or no flat field"
        raise BundleError(f"{bundle.subject}: table inputs", got, "a bundle that this version exported")
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


def calibrating_decoder(graphs: str | None, recording: Recording, profile: Profile) -> Decoder | None:
    """Load the decoder whose graphs calibrate the device of a recording.

    Args:
        graphs: path or name of its bundle; None for the shipped one.
        recording: recording of the device.
        profile: nominal device.

    Returns:
        The decoder; None where the shipped bundle does not fit.

    Raises:
        LightpageError: the named bundle does not fit; see `check_graphs`.
    """
    bundle = Bundle.open(bundle_path(DEFAULT if graphs is None else graphs))
    if bundle.profile != profile:
        if graphs is None:
            return None
        got = f"profile {bundle.profile.name}, with other numbers than profile {profile.name} of the recording"
        raise ProfileError(f"{bundle.subject}: profile", got, "the recording's profile")
    decoder = Decoder(bundle)
    try:
        check_graphs(decoder, recording)
    except LightpageError as error:
        if graphs is not None:
            raise
        note(f"not with the graphs of the shipped bundle: {error}")
        return None
    return decoder


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
        recording: recording with the pages of the calibration. Other pages with known symbols make the flat field, say
            what will be read, and choose the code of user bytes.
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
    pages = recorded_pages(recording, profile, used)
    device = calibration.device(profile, pages.blemishes.references)
    graph = neutral_graph(decoder, pages.blemishes)
    mask = decoder.bundle.pilot_mask
    twin = OnnxTwin(decoder.bundle)
    likelihood = GraphLikelihood(graph)
    blemishes, known, pair = without_late_dust(pages, likelihood, twin, device, calibration)
    measured = measured_table(
        likelihood, twin, device, known, statistics, mask, lambda share: progress("noise", 0.6 * share)
    )
    result = traced(decoder, twin, blemishes.references, calibration, gains=blemishes.gains)
    result = replace(result, table={**result.table, **measured})
    pilots = decoder.of_bundle(refitted_bundle(decoder.bundle, result)).pilots(256)
    result = replace(result, table={**result.table, **pilot_tensors(pilots)})
    new = decoder.of_bundle(refitted_bundle(decoder.bundle, result))
    assert isinstance(new.graph, EstimatorGraph)  # as that of `decoder`
    flat = flat_field_of(
        new.graph, recording, device, used, mask, lambda share: progress("flat field", 0.6 + 0.1 * share)
    )
    fitted = refitted_bundle(decoder.bundle, replace(result, table={**result.table, **flat.table}))
    for_corrected = new.graph.with_table({PIXEL_GAINS: blemishes.unit_gains})
    check_counts(for_corrected, KnownPhases.of(known[0], device), mask, f"recording {recording.path}, page {used[0]}")
    swapped = FramePair(pair.quadrature, pair.in_phase)
    created = datetime.now(UTC)
    name = name or profile.name
    manifest = fitted.manifest.model_copy(
        update={
            "name": name,
            "version": version or version_of(name, created, calibration.to_toml().encode()),
            "created": created.isoformat(timespec="seconds"),
            "metrics": {},
            "calibrated_pages": (*calibration.calibrated_pages, *flat.hashes),
            "residual_limit": residual_limit(
                new.infer(pair, doubtful=True).residual, new.infer(swapped, doubtful=True).residual
            ),
            "code": None,
            "earlier_codes": (),
            "provenance": Provenance(command=f"calibrated with the graphs of {decoder.version}"),
        }
    )
    new = decoder.of_bundle(replace(fitted, manifest=manifest))
    manifest = judged_manifest(new, recording, manifest, progress)
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


def judged_manifest(decoder: Decoder, recording: Recording, manifest: Manifest, progress: Progress) -> Manifest:
    """Return the manifest with a code of user bytes, and an estimator's with the verdict on its calibration.

    Raises:
        RecordingError: the recording is of another device.
    """
    progress("choose the code of user bytes", 0.7)
    manifest = _with_code(decoder, recording, manifest)
    bundle = decoder.bundle
    if not bundle.is_estimator:
        return manifest
    code = None if manifest.code is None else parse_code(manifest.code, bundle.subject)
    reading = reading_of(decoder, recording, code, progress)
    return manifest.model_copy(update={"calibration": bundle.calibration.judged(reading).to_toml()})


def _with_code(decoder: Decoder, recording: Recording, manifest: Manifest) -> Manifest:
    """Return the manifest with a code of user bytes; as it is, with a warning, where the pages allow none."""
    try:
        choice, _ = choose_code(decoder, recording, tracker_for(decoder))
    except InvalidInputError as lacking:
        warn(f"no code for user bytes: {lacking}")
        return manifest
    return manifest.model_copy(update={"code": choice.code.to_toml()})
