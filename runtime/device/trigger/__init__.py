"""Triggers, which fire both cameras at once."""
