"""Provenance of a trained artefact."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

from lightpage.files import replace_text

CHANGED = "+changes"
"""Follows the commit where files that it holds are changed."""
_FIRST = "begun_by.json"


def provenance() -> dict[str, Any]:
    """The command that is running, and the commit of this source tree when first asked for, empty without one."""
    return {"command": f"{_program()} {shlex.join(sys.argv[1:])}".strip(), "commit": commit()}


def provenance_of(folder: Path) -> dict[str, Any]:
    """Return the provenance of work that goes on in a folder, with the commit that it was begun with if another.

    Asked for before the work, it notes there who begins it.
    """
    now, path = provenance(), folder / _FIRST
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        replace_text(path, json.dumps(now) + "\n", "origin of a training")
    begun = json.loads(path.read_text("utf-8"))["commit"]
    return now if begun == now["commit"] else now | {"begun_at_commit": begun}


def _program() -> str:
    """Return the command that started the running program."""
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    return f"python -m {spec.name}" if spec is not None else Path(sys.argv[0]).name


@cache
def commit() -> str:
    """Return the commit of this source tree when first asked for.

    What is committed while a process works is not what it runs.
    """
    tree = Path(__file__).resolve().parents[2]
    toplevel, _, found = _git(tree, "rev-parse", "--show-toplevel", "HEAD").partition("\n")
    if not found or Path(toplevel) != tree.resolve():
        return ""
    return found + (CHANGED if _git(tree, "status", "--porcelain", "--untracked-files=no") else "")


def _git(tree: Path, *arguments: str) -> str:
    """Run git, and return its output; empty where git is missing or refuses."""
    try:
        done = subprocess.run(["git", "-C", str(tree), *arguments], capture_output=True, text=True, check=False)
    except OSError:
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""
