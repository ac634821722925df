"""Subcommands of `lightpage` that train."""
