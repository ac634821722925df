"""Subcommands that talk to a running service."""
