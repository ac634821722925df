"""Measurement of a calibrated device on its known pages: statistics of its counts, and tensors of its estimator."""

from __future__ import annotations

from collections.abc import Sequence

from lightpage.calibration.calibrate import KnownPage
from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.interfaces import Twin
from lightpage.calibration.likelihood.information import InformationFit
from lightpage.calibration.likelihood.interfaces import PageLikelihood, ProgressCallback
from lightpage.calibration.likelihood.statistics import Statistics
from lightpage.calibration.likelihood.table import launch_tensors
from lightpage.calibration.sampling_table import APART, SamplingTable, sampling_table
from lightpage.calibration.waves.wave_model import LaunchConditions


def light_table(twin: Twin, device: CalibratedDevice, conditions: LaunchConditions) -> SamplingTable:
    """Collect the tensors of a device's geometry, references and launched light.

    Args:
        twin: ray tracer of the nominal device.
        device: calibrated device.
        conditions: illumination and blur of its pages.
    """
    traced = sampling_table(twin, device.parameters, device.quadrature_phase_rad, device.profile)
    excluded = {"place_gradients", "phases", *APART} - {*device.apart_inputs}
    return {
        "reference_in_phase": device.references.in_phase,
        "reference_quadrature": device.references.quadrature,
        **{name: value for name, value in traced.items() if name not in excluded},
        **launch_tensors(device.profile, device.parameters, conditions, device.modulation),
    }


def measured_statistics(
    likelihood: PageLikelihood,
    twin: Twin,
    device: CalibratedDevice,
    pages: Sequence[KnownPage],
    conditions: LaunchConditions,
    progress: ProgressCallback = lambda share: None,
) -> Statistics:
    """Measure the statistics of a device's counts on known pages.

    Args:
        likelihood: likelihood of the device's pages.
        twin, device, conditions: see `light_table`.
        pages: known pages.
        progress: called with the finished share of the work.

    Raises:
        CalibrationError: the pages' light does not agree with the device.
    """
    fit = InformationFit(likelihood, light_table(twin, device, conditions), pages, device, progress)
    return fit.statistics(conditions)


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
        likelihood, twin, device, pages, progress: see `measured_statistics`.
        statistics: statistics of the device.
    """
    table = light_table(twin, device, statistics.conditions)
    return {**table, **InformationFit(likelihood, table, pages, device, progress).information(statistics)}
