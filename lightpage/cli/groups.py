"""Groups of commands whose help needs none of their options."""

from __future__ import annotations

from collections.abc import Sequence

import click

HELP = ("-h", "--help")


def help_at(arguments: Sequence[str]) -> int | None:
    """Place of the first argument that asks for help; None where none does."""
    options = arguments[: arguments.index("--")] if "--" in arguments else arguments
    return next((place for place, word in enumerate(options) if word in HELP), None)


class Group(click.Group):
    """A group that shows the help of its commands without its own required options."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read the options of the group, or show the help of one of its commands."""
        for place, word in enumerate(args[: help_at(args)] if help_at(args) is not None else []):
            if (command := self.get_command(ctx, word)) is not None:
                command.make_context(word, args[place + 1 :], parent=ctx)  # which shows it, and ends
        return super().parse_args(ctx, args)
