"""Decoders compared on the same light."""
