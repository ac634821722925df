"""Runs a command several times beside processes that keep the cores busy: `python -m tests.busy TIMES COMMAND ...`."""

import subprocess
import sys

from analysis.speed.beside_others import busy_cores

PROCESSES = 4


def main() -> int:
    """Return 1 if the command failed at least once."""
    if len(sys.argv) < 3 or not sys.argv[1].isdigit():
        sys.exit("usage: python -m tests.busy TIMES COMMAND ...")
    times, *command = sys.argv[1:]
    with busy_cores(PROCESSES):
        failed = sum(subprocess.run(command).returncode != 0 for _ in range(int(times)))
    print(f"{failed} of {times} failed beside {PROCESSES} busy processes")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
