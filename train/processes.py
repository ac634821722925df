"""The processes of one command: Lightning starts it once for each device."""

from __future__ import annotations

import os


def process_number() -> int:
    """Of this process, 0 for the one that a user started."""
    return int(os.environ.get("LOCAL_RANK", "0"))


def is_first_process() -> bool:
    """Whether this is the process that a user started, and not one that Lightning started for a further device."""
    return process_number() == 0
