"""Tensors of a calibrated device and of the estimation of its pages."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lightpage.calibration.calibrate import KnownPage
from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.coherence import seen_share
from lightpage.calibration.interfaces import Twin
from lightpage.calibration.likelihood.information import measured_information
from lightpage.calibration.likelihood.interfaces import PageLikelihood, ProgressCallback
from lightpage.calibration.likelihood.known_page_fit import KnownPageFit
from lightpage.calibration.likelihood.statistics import Statistics
from lightpage.calibration.likelihood.table import FLAT_FIELD, launch_tensors
from lightpage.calibration.sampling_table import APART, SamplingTable, sampling_table
from lightpage.calibration.waves.wave_model import LaunchConditions


def light_table(
    twin: Twin, device: CalibratedDevice, conditions: LaunchConditions, apart: tuple[str, ...] | None = None
) -> SamplingTable:
    """Collect the tensors of a device's geometry, references and launched light, without a flat field.

    Args:
        twin: ray tracer of the nominal device.
        device: calibrated device.
        conditions: illumination and blur of its pages.
        apart: names of the tensors of cameras that stand apart; those that the device needs if left out.
    """
    apart = device.apart_inputs if apart is None else apart
    traced = sampling_table(twin, device.parameters, device.quadrature_phase_rad, device.profile)
    excluded = {"place_gradients", "phases", *APART} - {*apart}
    return {
        "reference_in_phase": device.references.in_phase,
        "reference_quadrature": device.references.quadrature,
        **{name: value for name, value in traced.items() if name not in excluded},
        **launch_tensors(device.profile, device.parameters, conditions, device.modulation),
        FLAT_FIELD: np.zeros(device.profile.page_shape, np.float32),
    }


def estimator_table(
    likelihood: PageLikelihood,
    twin: Twin,
    device: CalibratedDevice,
    pages: Sequence[KnownPage],
    statistics: Statistics,
    progress: ProgressCallback = lambda share: None,
) -> SamplingTable:
    """Return the tensors that the estimation of a device's pages needs, except noise and pilots.

    Args:
        likelihood: likelihood of the device's pages.
        twin, device: see `light_table`.
        pages: known pages.
        statistics: statistics of the device.
        progress: called with the finished share of the work.
    """
    table = light_table(twin, device, statistics.conditions, likelihood.apart_inputs(device))
    fit = KnownPageFit(likelihood, table, pages, device.modulation)
    fit.fit_gains(statistics)
    seen = seen_share(twin, device.parameters, device.profile)
    return {**table, **measured_information(fit, seen, progress)}
