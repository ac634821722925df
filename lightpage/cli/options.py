"""Types of command-line options that more than one command has; those that name files are in `lightpage.files`."""

from __future__ import annotations

import math
from typing import Any

import click

from lightpage.device.profile import Profile, load_profile


class FiniteRange(click.FloatRange):
    """A number within bounds, and a number: infinity and NaN are within none."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """The number."""
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number.", param, ctx)
        return number


profile_option = click.option(
    "--profile",
    "profile_name",
    metavar="P",
    help="Nominal device: a shipped name or a file.  [default: the recording's own]",
)


def named_profile(name: str | None) -> Profile | None:
    """Return the profile that `profile_option` names; None where it names none."""
    return None if name is None else load_profile(name)
