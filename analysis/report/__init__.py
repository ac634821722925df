"""The report of a training run or of an evaluation: one HTML page for people."""
