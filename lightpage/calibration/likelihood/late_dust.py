"""Dust that settled on the cameras after their references were recorded, as known pages show it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lightpage.calibration.calibrate import KnownPage
from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.goodness.camera_faults import passed_light
from lightpage.calibration.goodness.light import PageLight
from lightpage.calibration.interfaces import Twin
from lightpage.calibration.likelihood.device_fit import shown_pages
from lightpage.calibration.likelihood.interfaces import PageLikelihood
from lightpage.calibration.likelihood.known_page_fit import KnownPageFit
from lightpage.calibration.likelihood.measure import light_table
from lightpage.calibration.likelihood.statistics import Statistics
from lightpage.recording.pixels.blemishes import Blemishes


def late_dust(
    likelihood: PageLikelihood,
    twin: Twin,
    device: CalibratedDevice,
    pages: Sequence[KnownPage],
    statistics: Statistics,
) -> Blemishes:
    """Find the shadows that the references do not show.

    Args:
        likelihood: likelihood of the device's pages.
        twin: ray tracer of the nominal device.
        device: calibrated device.
        pages: known pages without the blemishes that the references show.
        statistics: statistics of the device.
    """
    table = light_table(twin, device, statistics.conditions, likelihood.apart_inputs(device))
    fit = KnownPageFit(likelihood, table, pages, device.modulation)
    fit.fit_gains(statistics)
    lights = []
    for page in fit.pages:
        fit.fit_nuisance(page)
    for shown in shown_pages(device, statistics.conditions, fit.pages, pages):
        light = PageLight(twin, *shown)
        light.correct_amplitude()
        light.correct_counts()
        lights.append(light)
    frames = zip(*((light.pair.in_phase, light.pair.quadrature) for light in lights), strict=True)
    expected = zip(*(light.expected_frames() for light in lights), strict=True)
    passed = [passed_light(list(counts), list(clean)) for counts, clean in zip(frames, expected, strict=True)]
    return Blemishes.behind(np.stack(passed), device.references)
