"""Archives and fleets: page ranges of many recordings, read by many workers, each result written once."""
