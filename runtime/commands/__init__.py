"""Subcommands of `lightpage` that need no torch."""
