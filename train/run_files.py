"""Names of the files in the folder of a training run, for whoever looks at one without torch."""

BEGUN = "begun.json"
"""What the run was begun with."""
DESCRIPTION = "run.json"
"""What it is once it is finished."""
