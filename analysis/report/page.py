"""A report as one HTML page that asks nobody for anything."""

from __future__ import annotations

from importlib.metadata import version
from importlib.resources import files

import numpy as np
from jinja2 import Environment, StrictUndefined
from matplotlib import rc_context

from analysis.report import figures
from analysis.report.data import ReportData, exit_centroids
from analysis.report.tables import geometry, number, zones

TEMPLATE = "report.html.j2"


def render(data: ReportData) -> str:
    """The page, HTML; all text in it that came from files is escaped."""
    source = files("analysis.report").joinpath(TEMPLATE).read_text("utf-8")
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters["number"] = number
    centroids = exit_centroids(data.profile, data.calibration)
    with rc_context(figures.STYLE):
        return environment.from_string(source).render(
            data=data,
            measures=data.measures,
            calibration=data.calibration,
            turn_deg=float(np.rad2deg(data.calibration.turn_rad)),
            version=version("lightpage"),
            geometry=geometry(data),
            zones=zones(data, centroids),
            maps=figures.maps(data, centroids),
            reliability=[figures.reliability(data), figures.concentration(data)],
            training=data.curves if isinstance(data.curves, str) else figures.training(data.curves),
            page=data.golden if isinstance(data.golden, str) else figures.page(data.golden),
            rays=figures.rays(data),
        )
