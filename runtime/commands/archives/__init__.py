"""Subcommands that work on files: recordings, codes, bulk runs."""
