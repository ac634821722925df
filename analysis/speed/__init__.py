"""Decoders timed side by side."""
