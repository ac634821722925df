"""Subcommands that run the service, check its health, or time it."""
