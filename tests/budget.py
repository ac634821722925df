"""Runs a command and says how far it stayed below its budget: `python -m tests.budget NAME COMMAND ...`."""

import os
import resource
import subprocess
import sys
import time
import tomllib
from pathlib import Path


def main() -> int:
    """Run it, and return its exit status."""
    if len(sys.argv) < 3:
        sys.exit("usage: python -m tests.budget NAME COMMAND ...")
    name, *command = sys.argv[1:]
    budget = tomllib.loads(Path(__file__).with_name("limits.toml").read_text("utf-8"))["seconds"]
    begun = time.perf_counter()
    status = subprocess.run(command).returncode
    seconds, used = time.perf_counter() - begun, resource.getrusage(resource.RUSAGE_CHILDREN)
    left, cores = budget - seconds, len(os.sched_getaffinity(0))
    print(
        f"{name}: {seconds:.0f} s on {cores} cores ({used.ru_utime + used.ru_stime:.0f} s of CPU time), "
        f"{abs(left):.0f} s {'below' if left >= 0 else 'ABOVE'} its budget of {budget} s for two idle cores "
        "(tests/limits.toml)",
        flush=True,
    )
    return status


if __name__ == "__main__":
    sys.exit(main())
