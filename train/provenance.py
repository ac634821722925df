"""Where a trained artefact comes from."""

from __future__ import annotations

import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any


def provenance() -> dict[str, Any]:
    """The command that is running, and the commit of this source tree, empty where it is not one."""
    return {"command": f"{_program()} {shlex.join(sys.argv[1:])}".strip(), "commit": _commit()}


def _program() -> str:
    """How the running program was started."""
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    return f"python -m {spec.name}" if spec is not None else Path(sys.argv[0]).name


def _commit() -> str:
    tree = Path(__file__).parent.parent
    command = ["git", "-C", str(tree), "rev-parse", "--show-toplevel", "HEAD"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError:  # no git
        return ""
    toplevel, _, commit = done.stdout.strip().partition("\n")
    return commit if done.returncode == 0 and Path(toplevel) == tree.resolve() else ""
