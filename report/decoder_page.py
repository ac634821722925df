"""Page of a training run or of an evaluation."""

from __future__ import annotations

from typing import Any

import numpy as np

from lightpage.report import figures
from lightpage.report.contents.data import ReportData, exit_centroids
from lightpage.report.tables import geometry, zones

TEMPLATE = "report.html.j2"


def shown(data: ReportData) -> dict[str, Any]:
    """Tables and pictures, as the template takes them."""
    centroids = exit_centroids(data.profile, data.calibration)
    return {
        "measures": data.measures,
        "calibration": data.calibration,
        "turn_deg": float(np.rad2deg(data.calibration.turn_rad)),
        "geometry": geometry(data),
        "goodness": figures.goodness(data),
        "zones": zones(data, centroids),
        "maps": figures.maps(data, centroids),
        "reliability": [figures.reliability(data), figures.concentration(data)],
        "training": data.curves if isinstance(data.curves, str) else figures.training(data.curves),
        "page": data.golden if isinstance(data.golden, str) else figures.page(data.golden),
        "rays": figures.rays(data),
    }
