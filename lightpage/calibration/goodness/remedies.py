"""Words and remedies of the causes that cost information."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from lightpage.calibration.goodness.verdict import Cause


class Remedy(NamedTuple):
    """Words of a cause.

    Attributes:
        words: the cause.
        remedy: what a user can do about it.
    """

    words: str
    remedy: str


BEND = "bend"
BLACK_LEVEL = "black level"
CAMERA_TILT = "camera tilt"
CONTRAST = "contrast"
LEVELS = "levels"
NEIGHBOURS = "crosstalk"
OTHER_SYMBOLS = "other symbols"
UNKNOWN = "unknown"
CAMERA_PIXELS = "camera pixels"
DUST = "dust"
FLICKER = "flicker"
GHOST = "ghost"
DEAD_PIXELS = "dead modulator pixels"
REFERENCE_EXPOSURE = "reference exposure"
VIBRATION = "vibration"
WALLS = "walls"

REMEDIES = {
    "camera focus": Remedy("a curvature over the exit facet: cameras out of focus", "focus both cameras on one plane"),
    "image moved": Remedy(
        "a slope over the exit facet: a camera that moved since its reference was recorded", "record new references"
    ),
    "lens askew": Remedy("a saddle over the exit facet: the second lens is askew", "align the lens with the pipe"),
    "modulator focus": Remedy(
        "a curvature over the entrance facet: the modulator is out of focus", "move the modulator to the lens's focus"
    ),
    "modulator bent": Remedy(
        "a phase over the page: the modulator is not flat", "load the modulator's flatness correction"
    ),
    CAMERA_TILT: Remedy("a focus that changes over the image: tilted cameras", "stand the cameras upright"),
    "modulator tilt": Remedy("a focus that changes over the page: a tilted modulator", "stand the modulator upright"),
    WALLS: Remedy(
        "walls of the pipe that are not equally far apart in x and y, or that polarise light as such walls would",
        "ask the pipe's maker for its two widths; polarise the light along a wall",
    ),
    "taper": Remedy("a pipe that tapers", "ask the pipe's maker for the widths of both facets"),
    GHOST: Remedy("light that passes the pipe three times", "coat the facets against reflections, or wedge one"),
    CONTRAST: Remedy("a wrong ratio of interference and signal", "record references and pages alike"),
    REFERENCE_EXPOSURE: Remedy(
        "references of another exposure than the pages", "record references with the pages' exposure, each camera's own"
    ),
    BLACK_LEVEL: Remedy(
        "counts without light: a black level", "subtract the camera's black level, from pages and references"
    ),
    VIBRATION: Remedy(
        "fringes that lost contrast: vibration within an exposure", "shorten the exposure, or still the bench"
    ),
    BEND: Remedy("cameras that are not linear", "switch off gamma and gain control, or expose less"),
    CAMERA_PIXELS: Remedy("hot or dead pixels of a camera, few places", "cool or replace the camera"),
    DUST: Remedy(
        "dust on a camera that its reference does not show, few places; a bundle divides its shadows out of pages",
        "clean the camera and record new references",
    ),
    LEVELS: Remedy(
        "levels whose phases follow no smooth curve", "load the modulator's lookup table for this wavelength"
    ),
    NEIGHBOURS: Remedy(
        "phases that go with those of the symbols beside: crosstalk between the modulator's pixels",
        "write larger symbols, or the modulator's correction for fringing fields",
    ),
    FLICKER: Remedy(
        "a stroke that changes from page to page: flicker of the modulator",
        "expose for whole periods of the modulator's refresh, or choose its slow sequence",
    ),
    DEAD_PIXELS: Remedy("dead pixels of the modulator", "move the page, or leave these symbols out"),
    OTHER_SYMBOLS: Remedy(
        "light of other symbols", "check that these pages were written, in this order, and that this is their profile"
    ),
    UNKNOWN: Remedy(
        "nothing that the model knows: light comes by a way that it lacks, or not all symbols are as written",
        "a flat field or a trained network reads part of it",
    ),
}


_LEAST_SHARE = 0.2
"""Least share of what is lost that the named causes make, for the largest of them to be called the likeliest."""


def largest(causes: Sequence[Cause]) -> str:
    """Largest named cause in words, with its share of what is lost; the unknown one where the others are little."""
    total = sum(cause.bits for cause in causes)
    if not total:
        return ""
    named = [cause for cause in causes if cause.name != UNKNOWN]
    shown = causes[0] if sum(cause.bits for cause in named) >= _LEAST_SHARE * total else causes[-1]
    return f"{shown.what} ({shown.bits / total:.0%} of what is lost)"


def cause_of(name: str, bits: float, detail: str = "") -> Cause:
    """Return a cause with its words and its remedy."""
    words, remedy = REMEDIES[name]
    return Cause(name=name, bits=round(bits, 4), what=f"{words}{detail}", remedy=remedy)
