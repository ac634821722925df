"""Trainers: from a recording to a run."""
