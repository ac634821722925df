"""The report of a training run, an evaluation or a recovery: one HTML page for people."""
