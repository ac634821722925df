"""Bundles, which export writes and the runtime loads."""
