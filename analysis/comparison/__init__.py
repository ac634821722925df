"""Decoders compared on the same data."""
