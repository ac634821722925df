"""A modulator that is a monitor: its picture, and the process that owns its window."""
