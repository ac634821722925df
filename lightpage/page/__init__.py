"""Symbols, their phases, and pilots."""
