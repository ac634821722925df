"""The report of a training run, an evaluation, a recovery or a bulk run: one HTML page for people."""
