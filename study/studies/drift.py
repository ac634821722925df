"""Study of drift: a day's drift seen in crosshairs, and the amount of each drift that makes a recalibration due."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import ndimage, signal

from lightpage.device.profile import Profile, load_profile
from lightpage.device.state import Device
from lightpage.errors import InvalidInputError
from lightpage.page.levels import MAX_LEVELS
from lightpage.progress import Progress, reporting
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.evaluation import NothingReadError, evaluate
from lightpage.runtime.model.bundle.shipped import bundle_path
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.simulator.cameras import expose, resample
from lightpage.simulator.recording_job import RecordingJob
from lightpage.simulator.true_optics import TrueOptics
from lightpage.study.study import Case, Result, Row, Settings, Study

Real = NDArray[np.float64]

MINUTES = 2.5
"""Time from one frame to the next."""
HOURS = 24
_QUICK_FRAMES = 6
_FIRST_SEED = 10_000
"""First seed of the pages that are written: far from those of a recording that the shipped decoder was trained on."""
_CROSSHAIRS = 6
"""Along each axis."""
_SPAN = 0.75
"""Share of the zone that meets no wall, in which the crosshairs lie."""
_ARM_PX, _LINE_PX = 6, 2
"""Half length and width of a crosshair's lines, modulator pixels."""
_BACKGROUND_PX = 15 / 6
"""Standard deviation of a Gaussian kernel of 15 x 15 modulator pixels."""
_BRIGHTEST = 0.6
"""Share of the full well: with the reference blocked, exposure is longer."""

_WARM_UP_PX, _WARM_UP_HOURS = (0.9, -0.6), 1.0
_WALK_PX = 0.01
"""The drift that is simulated: a warm-up along x and y that dies away, and a random walk from frame to frame."""

_KEPT = 0.98
"""Share of the AIR below which a device is recalibrated."""
_BOTH_CAMERAS = ("in_phase_camera", "quadrature_camera")
_DRIFTS: dict[str, tuple[tuple[str, ...], str, tuple[float, ...]]] = {
    "pipe angle, degrees": (("geometry",), "pipe_angle_deg", (0.0025, 0.005, 0.01, 0.03)),
    "focal length, relative": (("geometry",), "focal_length_relative_error", (5e-5, 1e-4, 3e-4)),
    "camera rotation, degrees": (_BOTH_CAMERAS, "rotation_deg", (0.002, 0.005, 0.01, 0.03)),
    "camera scale, relative": (_BOTH_CAMERAS, "scale_relative_error", (5e-5, 1e-4, 2e-4, 5e-4)),
    "camera shift, pixels": (_BOTH_CAMERAS, "shift_x_px", (0.5, 1.0, 2.0)),
}
"""Drifts: the quantity's place in the device's state, and by how much."""
_BUNDLED = "bench"
"""Profile of the bundle that is shipped, whose AIR is measured."""


def crosshair_centres_m(profile: Profile) -> Real:
    """Crosshairs [36, 2] in the part of the page whose light meets no wall, row by row, metres from its centre."""
    pipe, focal = profile.pipe, profile.lens.focal_length_m
    half = 0.5 * pipe.width_m * focal * pipe.refractive_index / pipe.length_m
    reach = _SPAN * np.minimum(half, np.array([profile.page_width_m, profile.page_height_m]) / 2)
    x, y = (np.linspace(-end, end, _CROSSHAIRS) for end in reach)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def crosshair_phases(optics: TrueOptics) -> Real:
    """Phases of the modulator's pixels: the crosshairs' lines are even, all else is a checkerboard.

    The checkerboard throws its light beside the pipe's facet, so that the crosshairs are bright on a dark ground.
    """
    size, pitch = optics.profile.page.symbol_size_px, optics.profile.slm.pitch_m
    rows, columns = (count * size for count in optics.profile.page_shape)
    x, y = ((np.arange(count) - (count - 1) / 2) * pitch for count in (columns, rows))
    written = np.zeros((rows, columns), dtype=bool)
    arm, line = _ARM_PX * pitch, _LINE_PX * pitch / 2
    for centre_x, centre_y in crosshair_centres_m(optics.profile):
        off_x, off_y = np.abs(x[None, :] - centre_x), np.abs(y[:, None] - centre_y)
        written |= ((off_x <= arm) & (off_y <= line)) | ((off_y <= arm) & (off_x <= line))
    checkered = np.indices(written.shape).sum(axis=0) % 2
    return np.where(written, 0.0, np.pi * checkered)


def locate(frame: NDArray[np.integer], scale: float) -> Real:
    """Centres of the crosshairs on a frame, pixels (column, row), row by row, [36, 2].

    As the authors do: background off, correlated with a crosshair, squared, the highest peaks, each refined to its
    centre of mass. They do not tell of which pixels their kernel for the background has 15 x 15; so many of a camera
    that sees a modulator's pixel several times as wide as its own would take the crosshairs off too, so the
    modulator's are meant here. The correlation is smoothed by a camera pixel before it is squared, against shot noise.

    Args:
        frame: counts [H, W], reference blocked.
        scale: camera pixels a modulator pixel.
    """
    flat = frame.astype(np.float64)
    flat -= ndimage.gaussian_filter(flat, _BACKGROUND_PX * scale)
    arm, line = round(_ARM_PX * scale), round(_LINE_PX * scale / 2)
    kernel = np.zeros((2 * arm + 1, 2 * arm + 1))
    kernel[arm - line : arm + line + 1] = kernel[:, arm - line : arm + line + 1] = 1
    kernel -= kernel.mean()
    matched = signal.oaconvolve(np.pad(flat, arm, mode="edge"), kernel, mode="valid")
    model_match = ndimage.gaussian_filter(matched, 1.0) ** 2
    peaks = np.argwhere((model_match == ndimage.maximum_filter(model_match, 2 * arm + 1)) & (model_match > 0))
    best = peaks[np.argsort(model_match[tuple(peaks.T)])[::-1][: _CROSSHAIRS**2]]
    around = round(scale)
    centres = []
    for row, column in best:
        part = (slice(max(row - around, 0), row + around + 1), slice(max(column - around, 0), column + around + 1))
        inner = ndimage.center_of_mass(model_match[part])
        centres.append((part[1].start + inner[1], part[0].start + inner[0]))
    found = np.array(centres)
    by_row = found[np.argsort(found[:, 1])].reshape(_CROSSHAIRS, _CROSSHAIRS, 2)
    return np.concatenate([line[np.argsort(line[:, 0])] for line in by_row])


def simulated_walk(frames: int, seed: int) -> tuple[Real, Real]:
    """Hours [N] and true shifts [N, 2] in pixels of a simulated day."""
    hours = np.arange(frames, dtype=np.float64) * (HOURS / max(frames - 1, 1))
    warm_up = np.array(_WARM_UP_PX) * (1 - np.exp(-hours / _WARM_UP_HOURS))[:, None]
    steps = np.random.default_rng(seed).standard_normal((frames, 2))
    steps[0] = 0
    minutes = HOURS * 60 / max(frames - 1, 1)
    return hours, warm_up + _WALK_PX * np.sqrt(minutes / MINUTES) * np.cumsum(steps, axis=0)


def _crosshairs(settings: Settings, progress: Progress) -> Result:
    profile, device = settings.profile, Device()
    optics = TrueOptics(profile, device)
    field = optics.camera_field(optics.exit_field(crosshair_phases(optics)))
    power = np.abs(field) ** 2
    per_unit = _BRIGHTEST * device.sensor.full_well_e / float(np.quantile(power, 0.999))
    frames = _QUICK_FRAMES if settings.quick else round(HOURS * 60 / MINUTES) + 1
    hours, truth = simulated_walk(frames, settings.seed)
    scale = profile.slm.pitch_m / profile.image_pixel_m
    rng = np.random.default_rng([settings.seed, 1])
    found = []
    first = None
    for number, shift in enumerate(truth):
        progress("crosshairs", number / frames)
        view = optics.view(device.in_phase_camera, (float(shift[0]), float(shift[1])))
        counts = expose(resample(power, *optics.camera_axes_m, *view), per_unit, device.sensor, rng).astype(np.uint16)
        found.append(locate(counts, scale))
        first = counts if first is None else first
    drift = np.array(found) - found[0]
    day = {"hours": hours, "true": truth, "measured": drift.mean(axis=1), "frame": first, "marks": found[0]}
    return day | {"distance": np.linalg.norm(drift, axis=2).mean(axis=1)}


def _air(settings: Settings, case: Case, work: Path, progress: Progress) -> Result:
    """AIR of the shipped bundle on a drifted device, with piston and shift followed."""
    changes = []
    for table in case["tables"]:
        value = getattr(getattr(Device(), table), case["key"]) + case["amount"]
        changes.append(f"{table}.{case['key']}={value!r}")
    path, device = work / "R.h5", Device().with_settings(changes)
    with reporting(None):  # the case's own progress is shown
        progress("simulate", 0.0)
        seed = _FIRST_SEED + settings.seed
        job = RecordingJob(load_profile(_BUNDLED), device, MAX_LEVELS, seed, truth=False, out=path)
        job.claim(force=True)
        job.run(1 if settings.quick else 4)
        progress("evaluate", 0.5)
        decoder = Decoder.load(bundle_path(_BUNDLED))
        with Recording.open(path) as recording:
            try:
                found = evaluate(decoder, recording, tracker_for(decoder)).to_json()
            except NothingReadError as error:
                found = error.figures
    path.unlink()
    return {"air": air_of_all_pages(found), "bundle": f"{found['bundle_version']} ({found['bundle']['golden_sha256']})"}


def air_of_all_pages(evaluation: Mapping[str, Any]) -> float:
    """Bits per symbol of an evaluation as JSON has it; pages that could not be decoded carry nothing."""
    pages = evaluation["pages"]
    if not pages:
        return 0.0
    return float(evaluation["air_bits_per_symbol"] * pages / (pages + len(evaluation["refused_pages"])))


def _cases(settings: Settings) -> list[Case]:
    cases: list[Case] = [{"name": "crosshairs"}]
    if settings.profile.name != _BUNDLED:
        return cases
    cases.append({"name": "as-calibrated", "what": "nothing", "tables": (), "key": "", "amount": 0.0})
    for what, (tables, key, amounts) in _DRIFTS.items():
        for amount in amounts[1:2] if settings.quick else amounts:
            name = f"{key}-{amount:g}"
            cases.append({"name": name, "what": what, "tables": tables, "key": key, "amount": amount})
        if settings.quick:
            break
    return cases


def _measure(settings: Settings, case: Case, work: Path, progress: Progress) -> Result:
    return _crosshairs(settings, progress) if case["name"] == "crosshairs" else _air(settings, case, work, progress)


def _shares(cases: Sequence[Case], results: Sequence[Result]) -> dict[str, list[tuple[float, float]]]:
    """Amount and share of the AIR that is left, by what drifts."""
    airs = [(case, result["air"]) for case, result in zip(cases, results, strict=True) if "what" in case]
    if not airs:
        return {}
    bundles = {result["bundle"] for result in results if "bundle" in result}
    if len(bundles) > 1:
        raise InvalidInputError(
            "results of the study", f"of {', '.join(sorted(bundles))}", "of one bundle: another --out"
        )
    before = airs[0][1]
    shares: dict[str, list[tuple[float, float]]] = {}
    for case, air in airs[1:]:
        shares.setdefault(case["what"], []).append((case["amount"], air / before))
    return shares


def recalibrate_at(shares: Sequence[tuple[float, float]], kept: float = _KEPT) -> float | None:
    """Amount of drift, between those measured, at which only `kept` of the AIR is left; None if none cost as much."""
    last = (0.0, 1.0)
    for amount, share in shares:
        if share < kept:
            return last[0] + (amount - last[0]) * (last[1] - kept) / (last[1] - share)
        last = (amount, share)
    return None


def _rows(cases: Sequence[Case], results: Sequence[Result]) -> list[Row]:
    day = results[0]
    error = np.linalg.norm(day["measured"] - day["true"], axis=1)
    warm = day["hours"] >= 3
    since = np.linalg.norm(day["measured"][warm] - day["measured"][warm][0], axis=1)
    rows: list[Row] = [
        (
            "crosshairs: largest drift of their mean, pixels",
            float(np.linalg.norm(day["measured"], axis=1).max()),
            "",
            "",
        ),
        ("largest mean of their distances from the start", float(day["distance"].max()), "", ""),
        ("drift of their mean from the third hour on", float(since.max()), "", ""),
        ("error of a measured drift, root mean square", float(np.sqrt(np.mean(error**2))), "", ""),
    ]
    for what, shares in _shares(cases, results).items():
        limit = recalibrate_at(shares)
        for amount, share in shares:
            rows.append((what, amount, share, "" if limit is None else limit))
    return rows


def _plot(settings: Settings, cases: Sequence[Case], results: Sequence[Result]) -> Figure:
    figure = Figure(figsize=(15, 4.5), layout="constrained")
    frame_axis, day_axis, air_axis = figure.subplots(1, 3)
    day = results[0]
    frame_axis.imshow(day["frame"], cmap="gray")
    frame_axis.plot(*day["marks"].T, "+", color="tab:red")
    frame_axis.set_title("crosshairs, reference blocked")
    for component, colour in ((0, "tab:blue"), (1, "tab:orange")):
        day_axis.plot(day["hours"], day["measured"][:, component], color=colour, label=f"{'xy'[component]}, measured")
        day_axis.plot(day["hours"], day["true"][:, component], ":", color="k", linewidth=1)
    day_axis.plot(day["hours"], day["distance"], color="tab:green", label="mean distance of a crosshair")
    day_axis.set_xlabel("hours")
    day_axis.set_ylabel("drift, camera pixels (dotted: true)")
    day_axis.legend()
    for what, shares in _shares(cases, results).items():
        reference = _DRIFTS[what][2][1]
        points = np.array([(0.0, 1.0), *shares])
        air_axis.plot(points[:, 0] / reference, points[:, 1], "o-", label=f"{what}: 1 is {reference:g}")
    air_axis.axhline(_KEPT, color="k", linestyle="--", linewidth=1)
    air_axis.set_xlabel("drift")
    air_axis.set_ylabel("share of the AIR that is left")
    air_axis.set_ylim(bottom=0)
    if cases[1:]:
        air_axis.legend(loc="lower left")
    return figure


STUDY = Study(
    title="how far a day drifts, and when to recalibrate",
    source="supplement S13",
    cases=_cases,
    measure=_measure,
    header=("what drifts", "by", "AIR left", f"recalibrate at ({_KEPT:.0%} left)"),
    rows=_rows,
    plot=_plot,
)
