"""Where a trained artefact comes from."""

from __future__ import annotations

import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any


def provenance(program: str, seed: int) -> dict[str, Any]:
    """The command that is running, its seed, and the commit of this source tree, empty where it is not one.

    Args:
        program: how a reader would start it.
        seed: of everything random.
    """
    return {"command": shlex.join([*program.split(), *sys.argv[1:]]), "seed": seed, "commit": _commit()}


def _commit() -> str:
    tree = Path(__file__).parent.parent
    command = ["git", "-C", str(tree), "rev-parse", "--show-toplevel", "HEAD"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError:  # no git
        return ""
    toplevel, _, commit = done.stdout.strip().partition("\n")
    return commit if done.returncode == 0 and Path(toplevel) == tree.resolve() else ""
