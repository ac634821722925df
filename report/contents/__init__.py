"""Contents of a report, read from a run, an evaluation, a recovery or a bulk run."""
