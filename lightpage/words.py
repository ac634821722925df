"""Words that errors and commands have in common."""

from __future__ import annotations


def counted(number: int, noun: str) -> str:
    """Format a number with its noun, e.g. ``1 page``, ``2 pages``."""
    return f"{number} {noun}{'' if number == 1 else 's'}"
