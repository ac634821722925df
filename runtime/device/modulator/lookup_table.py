"""The lookup table of a phase modulator: which grey value shows which level."""

import math
import re
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import InvalidInputError
from lightpage.files import read_text
from lightpage.page.levels import MIN_LEVELS
from lightpage.progress import warn

GREYS = 256
"""Grey values of a modulator: 8 bits."""
MOST_SHORT = 0.06
"""Share of the phases from level 0 to level M - 1 that a modulator may lack: a stroke that is 5% too short lacks it."""
CALIBRATION_HEADER = ["phase_rad", "grey"]
LEVELS_HEADER = ["grey"]

_COMMENT = re.compile(r"#.*")
_SEPARATOR = re.compile(r"[\s,;]+")


def linear_table(levels: int) -> NDArray[np.uint8]:
    """Grey values [M] of a modulator whose 256 grey values span one wave evenly: grey = round(256 level / M)."""
    return (np.arange(levels) * GREYS / levels).round().astype(np.uint8)


def read_table(path: Path, levels: int) -> NDArray[np.uint8]:
    """Grey values [M], all different, of a text file: numbers between commas, semicolons or white space.

    Comments begin with ``#``. The first line says which of two forms the file has:

    - ``phase_rad grey``: a calibration of the modulator. Each line below it has a phase in radians and the grey value
      that shows it. Phases may be wrapped, and differ by less than pi from one grey value to the next. Level k gets the
      grey value that lies 2 pi k / M above the lowest phase, interpolated and rounded; a phase that all levels share
      makes no difference to a page. Phases that span up to `MOST_SHORT` less are shared out evenly, with a warning.
    - ``grey``, or the first number: grey values of level 0, 1, ... M - 1, in lines of any length.

    Args:
        path: the file.
        levels: M, 2 to 256.

    Raises:
        InvalidInputError: a file that cannot be read; not a number; a grey value that is not whole or not in 0..255;
            another count than M; two levels of one grey value; a calibration whose phase does not rise or fall all
            along, or that spans too little for M levels.
    """
    subject = f"lookup table {path}"
    text = read_text(path, subject, "a readable text file")
    lines = [
        (number, words)
        for number, line in enumerate(text.splitlines(), 1)
        if (words := [word for word in _SEPARATOR.split(_COMMENT.sub("", line)) if word])
    ]
    if lines and lines[0][1] == CALIBRATION_HEADER:
        return _of_calibration(lines[1:], levels, subject)
    return _different(_of_levels(lines, levels, subject), subject)


Line = tuple[int, list[str]]
"""Number of a line in its file, and its words."""


def _number(word: str, where: str) -> float:
    try:
        number = float(word)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise InvalidInputError(where, repr(word), "a number")
    return number


def _grey(word: str, where: str) -> int:
    number = _number(word, where)
    if not number.is_integer() or not 0 <= number < GREYS:
        raise InvalidInputError(where, f"grey value {word}", f"a whole number from 0 to {GREYS - 1}")
    return int(number)


def _of_levels(lines: list[Line], levels: int, subject: str) -> NDArray[np.uint8]:
    """Grey values as the file lists them."""
    if lines and lines[0][1] == LEVELS_HEADER:
        lines = lines[1:]
    greys = [_grey(word, f"{subject}, line {number}") for number, words in lines for word in words]
    if len(greys) != levels:
        expected = f"{levels}, one per level, or a calibration below the line '{' '.join(CALIBRATION_HEADER)}'"
        raise InvalidInputError(subject, f"{len(greys)} grey values", expected)
    return np.array(greys, np.uint8)


def _of_calibration(lines: list[Line], levels: int, subject: str) -> NDArray[np.uint8]:
    """Grey values interpolated in a measured phase curve."""
    points: dict[int, float] = {}
    for number, words in lines:
        where = f"{subject}, line {number}"
        if len(words) != 2:
            raise InvalidInputError(where, f"{len(words)} values", "two: a phase in radians and a grey value")
        grey = _grey(words[1], where)
        if grey in points:
            raise InvalidInputError(where, f"grey value {grey} once more", "one phase per grey value")
        points[grey] = _number(words[0], where)
    return _of_curve(points, levels, subject)


def _of_curve(points: dict[int, float], levels: int, subject: str) -> NDArray[np.uint8]:
    """Grey values interpolated between those whose phases, radians, are known."""
    greys, lacking = _even(points, levels, subject)
    if lacking > 1e-9:
        warn(f"{subject}: too short a stroke; level {levels - 1} of {levels} lies {lacking:.2g} rad too low")
    return greys


def _even(points: dict[int, float], levels: int, subject: str) -> tuple[NDArray[np.uint8], float]:
    """Different grey values [M] at even phases, and the phase, radians, that the modulator lacks for the last one."""
    if len(points) < 2:
        raise InvalidInputError(subject, f"a calibration of {len(points)} grey values", "at least 2")
    greys = np.array(sorted(points))
    phase = np.unwrap([points[grey] for grey in greys])
    steps = np.diff(phase)
    if not ((steps > 0).all() or (steps < 0).all()):
        turn = int(np.argmax(np.sign(steps) != np.sign(steps[0])))
        got = f"a phase that turns back, or stands still, between grey values {greys[turn]} and {greys[turn + 1]}"
        raise InvalidInputError(subject, got, "one that rises or falls all along; smooth a noisy calibration first")
    if steps[0] < 0:
        greys, phase = greys[::-1], phase[::-1]
    last, span = 2 * math.pi * (levels - 1) / levels, float(phase[-1] - phase[0])
    if (lacking := last - span) > MOST_SHORT * last:
        raise InvalidInputError(subject, f"phases over {span:.4g} rad", f"{last:.4g} rad for {levels} levels")
    found = np.interp(phase[0] + np.linspace(0.0, min(last, span), levels), phase, greys)
    return _different(found.round().astype(np.uint8), subject), max(0.0, lacking)


def most_levels(curve: dict[int, float], subject: str) -> int:
    """Most levels that `read_table` makes even by the phases, radians, of some grey values.

    Raises:
        InvalidInputError: not even two; it is about `subject`.
    """
    for levels in range(GREYS, MIN_LEVELS, -1):
        with suppress(InvalidInputError):
            _even(curve, levels, subject)
            return levels
    _even(curve, MIN_LEVELS, subject)
    return MIN_LEVELS


def calibration_text(curve: dict[int, float]) -> str:
    """A file with the phase, radians, of grey values."""
    lines = [f"{phase:.5f} {grey}" for grey, phase in sorted(curve.items())]
    return "\n".join([" ".join(CALIBRATION_HEADER), *lines]) + "\n"


def levels_text(curve: dict[int, float], levels: int, subject: str) -> str:
    """A file with the grey values of so many levels, by the phases, radians, of some.

    Raises:
        InvalidInputError: see `read_table`; it is about `subject`.
    """
    greys = _of_curve(curve, levels, subject)
    return "\n".join([*LEVELS_HEADER, *map(str, greys.tolist())]) + "\n"


def _different(greys: NDArray[np.uint8], subject: str) -> NDArray[np.uint8]:
    """Return the table with a grey value of its own for each level."""
    values, counts = np.unique(greys, return_counts=True)
    if (counts > 1).any():
        shared = int(values[counts > 1][0])
        first, second = np.flatnonzero(greys == shared)[:2]
        raise InvalidInputError(subject, f"grey value {shared} for levels {first} and {second}", "one for each level")
    return greys
