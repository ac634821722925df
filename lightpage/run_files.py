"""Names of the files in the folder of a training run, for whoever looks at one without torch."""

BEGUN = "begun.json"
"""File of what the run was begun with."""
DESCRIPTION = "run.json"
"""File of what it is once it is finished."""
