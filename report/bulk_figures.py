"""The figures of the report of a bulk run: its speed over time, its losses, and its devices."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from lightpage.report.contents.from_bulk import LISTED, MEASURES, PAGES, BulkData, Device, Recalibration, sessions
from lightpage.report.drawing import BLUE, GREEN, GREY, ORANGE, Picture, as_picture, new_figure, one_axis
from lightpage.report.words import number
from lightpage.runtime.archives.run.totals import Reading

TEMPLATE = "bulk.html.j2"

_POINTS = 120
"""Points of a curve over time."""
_DRAWN = 30
"""Devices that are drawn; the worst of more."""

Real = NDArray[np.float64]


def shown(data: BulkData) -> dict[str, Any]:
    """The pictures, as the template takes them."""
    readings = data.found.readings
    drawn = data.devices[:_DRAWN]
    known = [each for each in data.recalibrations or () if each.air_before is not None and each.air_after is not None]
    speeds = [speed(readings, data.unit), page_seconds(readings, data.unit)] if readings else []
    devices = [by_device(drawn, measure, data.fleet) for measure in data.measures]
    if known:
        devices.append(recalibrations(known[:_DRAWN]))
    return {
        "speeds": speeds,
        "losses": [losses(data.causes, data.unit, data.lost)] if data.causes else [],
        "devices": devices,
        "measure_names": MEASURES,
        "listed": LISTED,
        "drawn": _DRAWN,
    }


def rates(readings: Sequence[Reading], edges: Real) -> tuple[Real, Real]:
    """Pages a second, and workers at work, between moments; the pages of a range are spread over its time.

    Args:
        readings: ranges that were read, N of them.
        edges: the moments, seconds since 1970, [B + 1].

    Returns:
        Both [B].
    """
    end = np.array([reading.finished_s for reading in readings])
    took = np.maximum(np.array([reading.seconds for reading in readings]), 1e-6)
    pages = np.array([reading.pages for reading in readings], dtype=np.float64)
    behind = np.zeros((2, len(edges)))
    for place, edge in enumerate(edges):
        share = np.clip((edge - (end - took)) / took, 0.0, 1.0)
        behind[:, place] = (share * pages).sum(), (share * took).sum()
    done, worked = np.diff(behind) / np.maximum(np.diff(edges), 1e-9)
    return done, worked


def speed(readings: Sequence[Reading], unit: str) -> Picture:
    """Pages a second over the time at work, and how many workers were at it; pauses are left out."""
    parts = sessions(readings)
    whole = sum(end - begin for begin, end in parts)
    scale, word = (3600.0, "h") if whole > 3 * 3600 else (60.0, "min") if whole > 300 else (1.0, "s")
    figure = new_figure()
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    before, most = 0.0, 0.0
    for begin, end in parts:
        edges = np.linspace(begin, end, 2 + int(_POINTS * (end - begin) / max(whole, 1e-9)))
        done, worked = rates(readings, edges)
        at = (before + edges - begin) / scale
        above.stairs(done, at, color=BLUE, fill=True, alpha=0.25)
        above.stairs(done, at, color=BLUE, linewidth=1.2)
        below.stairs(worked, at, color=GREEN, fill=True, alpha=0.4)
        if before:
            for axis in (above, below):
                axis.axvline(before / scale, color=GREY, linewidth=0.8, linestyle=":")
        most, before = max(most, float(done.max())), before + end - begin
    mean = sum(reading.pages for reading in readings) / max(whole, 1e-9)
    above.axhline(mean, color=ORANGE, linewidth=1, linestyle="dashed", label=f"mean {number(mean, 2)}")
    above.set(ylabel=f"{unit}/s", ylim=(0, 1.1 * most))
    above.legend(frameon=False, loc="lower right")
    below.set(xlabel=f"time at work, {word}", ylabel="at work")
    below.set_ylim(bottom=0)
    below.yaxis.set_major_locator(MaxNLocator(integer=True, nbins=3))
    pauses = " Dotted: here the run had stopped and was taken up again." if len(parts) > 1 else ""
    caption = (
        f"{unit.capitalize()} a second of all workers together, by their machines' clocks, and below how many were at "
        f"work.{pauses}"
    )
    return as_picture(figure, f"Speed over time, mean {number(mean, 2)} {unit} a second.", caption)


def page_seconds(readings: Sequence[Reading], unit: str) -> Picture:
    """Draw the histogram of ranges' times by the page: stragglers lie to the right."""
    seconds = np.array([reading.seconds / max(1, reading.pages) for reading in readings])
    median, slow = np.quantile(seconds, (0.5, 0.99))
    figure, axis = one_axis()
    axis.hist(seconds, bins=min(40, max(5, len(seconds) // 3)), color=BLUE, edgecolor="white")
    axis.axvline(float(median), color=ORANGE, linestyle="dashed", linewidth=1, label=f"median {number(median, 3)} s")
    ranges = "ranges" if unit == PAGES else unit
    axis.set(xlabel=f"s a {unit[:-1]}" + (", mean of a range" if unit == PAGES else ""), ylabel=ranges)
    axis.set_xlim(left=0)
    axis.yaxis.set_major_locator(MaxNLocator(integer=True))
    axis.legend(frameon=False)
    caption = f"A worker's time for a {unit[:-1]}" + (", range by range" if unit == PAGES else "")
    caption += f": median {number(median, 3)} s, one in a hundred above {number(slow, 3)} s."
    if unit == PAGES:
        caption += " Short ranges take longer, since the image is looked for on their first page."
    return as_picture(figure, f"Times of {len(seconds):,} {ranges}, median {number(median, 3)} s.", caption)


def losses(causes: Sequence[tuple[str, int, float, str]], unit: str, lost: str) -> Picture:
    """Draw how many were lost, or refused, by each cause."""
    figure, axis = one_axis()
    names, counts = [cause for cause, *_ in causes][::-1], [count for _, count, *_ in causes][::-1]
    bars = axis.barh(range(len(names)), counts, color=ORANGE, height=0.6)
    axis.bar_label(bars, [f" {count:,}" for count in counts])
    axis.set_yticks(range(len(names)), names)
    axis.set(xlabel=f"{unit} {lost}", xlim=(0, 1.15 * max(counts)), ylim=(-1, len(names)))
    axis.xaxis.set_major_locator(MaxNLocator(integer=True))
    told = ", ".join(f"{count:,} {cause}" for cause, count, *_ in causes)
    caption = f"{unit.capitalize()} {lost}, by cause"
    return as_picture(figure, f"{caption}: {told}.", f"{caption}.")


def by_device(devices: Sequence[Device], measure: str, fleet: bool) -> Picture:
    """A measure of each: the mean of its pages, and down to the least; coloured by what the pilots say."""
    known = [device for device in devices if device.group.figures[measure].value is not None][::-1]
    figure, axis = one_axis()
    for row, device in enumerate(known):
        mean, least = device.group.figures[measure].value, device.group.figures[measure].least
        if mean is None or least is None:
            continue
        axis.plot([least, mean], [row, row], color=GREY, linewidth=1)
        axis.plot(least, row, "|", color=GREY, markersize=8, label=None if row else "worst page")
        changed = _changed(device)
        axis.plot(mean, row, "D" if changed else "o", color=ORANGE if changed else BLUE, markersize=5)
    axis.plot([], [], "o", color=BLUE, markersize=5, label="mean")
    if any(_changed(device) for device in known):
        axis.plot([], [], "D", color=ORANGE, markersize=5, label="mean, device changed")
    _name_rows(axis, known)
    axis.set(xlabel=f"{MEASURES[measure]}, bit/symbol")
    if measure == "margin_bits":
        axis.axvline(0, color=GREY, linestyle="dashed", linewidth=1, label="what the code needs")
    figure.legend(frameon=False, loc="outside upper center", ncols=3)
    who = "device" if fleet else "recording"
    name = f"{MEASURES[measure][0].upper()}{MEASURES[measure][1:]}, by {who}"
    caption = f"{name}: mean of the pages that were read."
    if any(_changed(device) for device in known):
        caption += " Orange: the pilots of most pages show that the device is no longer as it was calibrated."
    return as_picture(figure, f"{name}, {len(known)} of them.", caption)


def _changed(device: Device) -> bool:
    return 2 * device.group.recalibration_due > device.group.read


def recalibrations(known: Sequence[Recalibration]) -> Picture:
    """AIR of each device before and after its recalibration."""
    figure, axis = one_axis()
    for row, device in enumerate(known[::-1]):
        before, after = device.air_before, device.air_after
        if before is None or after is None:
            continue
        axis.plot([before, after], [row, row], color=GREY, linewidth=1)
        axis.plot(before, row, "o", color=ORANGE, fillstyle="none", markersize=5, label=None if row else "before")
        axis.plot(after, row, "o", color=BLUE, markersize=5, label=None if row else "after")
    _name_rows(axis, known[::-1])
    axis.set(xlabel="AIR, bit/symbol")
    figure.legend(frameon=False, loc="outside upper center", ncols=2)
    caption = "AIR of the pages that were held back, with the bundle before and with the new one."
    return as_picture(figure, f"AIR of {len(known)} devices before and after.", caption)


def _name_rows(axis: Any, devices: Sequence[Device | Recalibration]) -> None:
    names = [name if len(name) <= 24 else f"…{name[-23:]}" for name in (device.name for device in devices)]
    axis.set_yticks(range(len(names)), names, fontsize=7 if len(names) > 12 else 9)
    axis.set_ylim(-0.8, max(len(names), 3) - 0.2)
