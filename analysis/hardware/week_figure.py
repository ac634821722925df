"""The picture of a week: AIR with the service's model and the true table, shift of the image, recalibrations."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lightpage.pictures import write_figure_png


def draw(rows: list[dict[str, Any]], path: Path, knock: int, page_s: float) -> None:
    """Draw the rows of `analysis.hardware.week` into the PNG file `path`."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    days = np.array([row["page"] for row in rows]) * page_s / 86_400
    figure, (air, shift) = plt.subplots(2, 1, figsize=(10, 6), sharex=True, layout="constrained")
    air.plot(days, [row["true_air"] for row in rows], color="0.6", label="fed the true table")
    air.plot(days, [row["air"] for row in rows], ".", markersize=3, label="in service")
    air.set_ylabel("AIR, bits a symbol")
    found = [row["shift_px"] or (np.nan, np.nan) for row in rows]
    for axis, values in zip("xy", np.array(found, float).T, strict=True):
        shift.plot(days, values, ".", markersize=3, label=f"{axis}, since calibration")
    shift.set_ylabel("shift of the image, camera pixels")
    shift.set_xlabel("days")
    for each in (air, shift):
        told = set[str]()
        for number, end in [(n, end) for n, row in enumerate(rows) for end in row["ended"]]:
            label, colour = ("recalibrated", "tab:green") if end == "done" else ("refused or failed", "tab:red")
            each.axvline(days[number], color=colour, linewidth=0.6, zorder=0, label=None if label in told else label)
            told.add(label)
        each.axvline(knock * page_s / 86_400, color="black", linestyle="--", linewidth=0.8, label="knock")
        each.legend(loc="lower right")
    write_figure_png(path, figure, dpi=130)
    plt.close(figure)
