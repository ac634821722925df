"""Runs a command several times beside processes that keep the cores busy: `python -m tests.busy TIMES COMMAND ...`."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import ExitStack

PROCESSES = 4
_BUSY = "import os, sys\nwhile os.getppid() == int(sys.argv[1]):\n    sum(range(100_000))"


def main() -> int:
    """Return 1 if the command failed at least once."""
    times, *command = sys.argv[1:]
    with ExitStack() as stack:
        for _ in range(PROCESSES):
            busy = stack.enter_context(subprocess.Popen([sys.executable, "-c", _BUSY, str(os.getpid())]))
            stack.callback(busy.kill)
        failed = sum(subprocess.run(command).returncode != 0 for _ in range(int(times)))
    print(f"{failed} of {times} failed beside {PROCESSES} busy processes")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
