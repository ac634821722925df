"""Archives: many recorded pages read at once, by one process or by many workers, each result written once.

`recordings` evaluates and recovers the pages of one recording, `run` keeps what a bulk run was asked and has found, and
`workers` read page ranges. This room imports `model` and `recalibration`; it needs no service.
"""
