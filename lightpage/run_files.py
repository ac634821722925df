"""Names by which what commands write is known, for whoever looks at it without what they need."""

BEGUN = "begun.json"
"""File of what a training run was begun with."""
DESCRIPTION = "run.json"
"""File of what it is once it is finished."""
EVALUATE, RECOVER = "evaluate", "recover"
REPORT_MARKS = {
    EVALUATE: {"bundle_version", "pages"},
    RECOVER: {"page_results", "user_bytes_per_page"},
    "decode": {"target", "refused_pages"},
}
"""Keys that together stand in the JSON of one command only."""
