"""What a report shows, read from a run, an evaluation, a recovery or a bulk run."""
