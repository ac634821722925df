"""Statistics of a calibrated device by its known pages, and the tensors by which its pages are estimated."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from lightpage.calibration.calibrate import KnownPage
from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.interfaces import Twin
from lightpage.calibration.likelihood.information import InformationFit
from lightpage.calibration.likelihood.interfaces import PageLikelihood
from lightpage.calibration.likelihood.statistics import Statistics
from lightpage.calibration.likelihood.table import launch_tensors
from lightpage.calibration.sampling_table import APART, SamplingTable, sampling_table
from lightpage.calibration.waves.wave_model import LaunchConditions

Told = Callable[[float], None]


def light_table(twin: Twin, device: CalibratedDevice, conditions: LaunchConditions) -> SamplingTable:
    """Tensors of a device's geometry, references and launched light.

    Args:
        twin: ray tracer of the nominal device.
        device: calibrated device.
        conditions: illumination and blur of its pages.
    """
    traced = sampling_table(twin, device.parameters, device.quadrature_phase_rad, device.profile)
    left_out = {"place_gradients", "phases", *APART} - {*device.apart_inputs}
    return {
        "reference_in_phase": device.references.in_phase,
        "reference_quadrature": device.references.quadrature,
        **{name: value for name, value in traced.items() if name not in left_out},
        **launch_tensors(device.profile, device.parameters, conditions, device.modulation),
    }


def measured_statistics(
    likelihood: PageLikelihood,
    twin: Twin,
    device: CalibratedDevice,
    pages: Sequence[KnownPage],
    conditions: LaunchConditions,
    progress: Told = lambda share: None,
) -> Statistics:
    """Measure the statistics of a device's counts by known pages.

    Args:
        likelihood: of the device's pages.
        twin, device, conditions: see `light_table`.
        pages: known pages.
        progress: function that takes the share of the work that is done; it may raise to stop it.

    Raises:
        CalibrationError: pages that do not agree with the device.
    """
    fit = InformationFit(likelihood, light_table(twin, device, conditions), pages, device, progress)
    return fit.statistics(conditions)


def estimator_table(
    likelihood: PageLikelihood,
    twin: Twin,
    device: CalibratedDevice,
    pages: Sequence[KnownPage],
    statistics: Statistics,
    progress: Told = lambda share: None,
) -> SamplingTable:
    """Return all tensors by which a device's pages are estimated, but for noise and pilots.

    Args:
        likelihood, twin, device, pages, progress: see `measured_statistics`.
        statistics: statistics of the device.
    """
    table = light_table(twin, device, statistics.conditions)
    return {**table, **InformationFit(likelihood, table, pages, device, progress).information(statistics)}
