"""Words that errors, commands and reprs have in common."""

from __future__ import annotations


def counted(number: int, noun: str) -> str:
    """Format a number with its noun, e.g. ``1 page``, ``2 pages``."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def sides(shape: tuple[int, ...]) -> str:
    """Return the sides of an array, e.g. ``56 x 87``."""
    return " x ".join(map(str, shape))


def brief(thing: object, *facts: str) -> str:
    """Return a repr of one line, e.g. ``<Recording mine.h5, 30 pages>``: arrays are told by their sizes."""
    return f"<{type(thing).__name__} {', '.join(facts)}>"
