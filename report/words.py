"""Numbers as a report writes them."""

from __future__ import annotations


def number(value: float, digits: int) -> str:
    """A number with so many digits behind the point; no zero is negative."""
    return f"{value:z.{digits}f}".replace("-", "−")


def signed(count: int) -> str:
    """A whole number with its sign, zero without."""
    return f"{count:+d}".replace("-", "−") if count else "0"


def how_long(seconds: float) -> str:
    """Seconds as people say them."""
    return f"{seconds / 60:.1f} min" if seconds >= 60 else f"{seconds:.1f} s"
