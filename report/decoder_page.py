"""Page of a training run or of an evaluation."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import numpy as np

from lightpage.metrics.measures import SMOOTH
from lightpage.report import figures
from lightpage.report.contents.data import ReportData
from lightpage.report.tables import geometry, zones

TEMPLATE = "report.html.j2"
NOT_TRACED = "Nothing is traced here: that needs the extra train, pip install 'lightpage[train]'."


def shown(data: ReportData) -> dict[str, Any]:
    """Tables and pictures, as the template takes them."""
    centroids = paths = None
    if find_spec("torch") is not None:
        from lightpage.report.traced import exit_centroids, ray_paths

        centroids, paths = exit_centroids(data.profile, data.calibration), ray_paths(data)
    curves = data.curves
    return {
        "measures": data.measures,
        "calibration": data.calibration,
        "turn_deg": float(np.rad2deg(data.calibration.turn_rad)),
        "geometry": geometry(data),
        "goodness": figures.goodness(data),
        "zones": NOT_TRACED if centroids is None else zones(data, centroids),
        "smooth": SMOOTH,
        "maps": figures.maps(data, centroids),
        "reliability": [figures.reliability(data), figures.concentration(data)],
        "drift": figures.drift(data),
        "training": curves if curves is None or isinstance(curves, str) else figures.training(curves),
        "page": data.golden if isinstance(data.golden, str) else figures.page(data.golden),
        "rays": NOT_TRACED if paths is None else figures.rays(data, paths),
    }
