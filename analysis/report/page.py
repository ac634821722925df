"""A report as one HTML page that asks nobody for anything."""

from __future__ import annotations

from importlib.metadata import version
from importlib.resources import files
from typing import Any

import numpy as np
from jinja2 import Environment, FunctionLoader, StrictUndefined
from matplotlib import rc_context

from analysis.report import figures, recovery_figures
from analysis.report.data import ReportData, exit_centroids
from analysis.report.drawing import STYLE
from analysis.report.from_recovery import RecoveryData
from analysis.report.tables import geometry, number, zones

TEMPLATE, RECOVERY_TEMPLATE = "report.html.j2", "recovery.html.j2"


def render(data: ReportData | RecoveryData) -> str:
    """The page, HTML; all text in it that came from files is escaped."""
    environment = Environment(
        loader=FunctionLoader(lambda name: files("analysis.report").joinpath(name).read_text("utf-8")),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["number"] = number
    with rc_context(STYLE):
        if isinstance(data, RecoveryData):
            name, shown = RECOVERY_TEMPLATE, _of_recovery(data)
        else:
            name, shown = TEMPLATE, _of_decoder(data)
    return environment.get_template(name).render(data=data, version=version("lightpage"), **shown)


def _of_decoder(data: ReportData) -> dict[str, Any]:
    centroids = exit_centroids(data.profile, data.calibration)
    return {
        "measures": data.measures,
        "calibration": data.calibration,
        "turn_deg": float(np.rad2deg(data.calibration.turn_rad)),
        "geometry": geometry(data),
        "zones": zones(data, centroids),
        "maps": figures.maps(data, centroids),
        "reliability": [figures.reliability(data), figures.concentration(data)],
        "training": data.curves if isinstance(data.curves, str) else figures.training(data.curves),
        "page": data.golden if isinstance(data.golden, str) else figures.page(data.golden),
        "rays": figures.rays(data),
    }


def _of_recovery(data: RecoveryData) -> dict[str, Any]:
    if not data.pages:
        return {"pictures": []}
    drawn = recovery_figures.margins(data.pages), recovery_figures.failed_codewords(data.pages, data.blocks_per_page)
    return {"pictures": drawn}
