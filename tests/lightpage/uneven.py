"""Levels of a modulator that is not even, for tests."""

from lightpage.page.levels import Levels
from lightpage.page.modulation import NAMES, NOMINAL, Modulation


def modulation(**changes: float) -> Modulation:
    """Return a modulation with these coefficients, all others zero."""
    assert set(changes) <= set(NAMES)
    return Modulation(tuple((NOMINAL.as_dict() | changes).values()))


UNEVEN = modulation(stroke_relative=-0.1, phase_cos_1_rad=0.1, phase_sin_1_rad=0.25, amplitude_cos_1_log=0.1)
"""A stroke that is too short, and a lookup table that is not straight."""
OVERLAPPING = modulation(stroke_relative=0.2, phase_sin_1_rad=-0.3)
"""A stroke of more than one turn."""


def uneven(count: int) -> Levels:
    return UNEVEN.page_levels(count)


def overlapping(count: int) -> Levels:
    return OVERLAPPING.page_levels(count)
