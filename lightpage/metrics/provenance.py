"""Provenance of figures: the command, source, machine, time and inputs that they are from."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Iterator
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

from lightpage.failures import os_failure
from lightpage.files import write_json
from lightpage.systems import cores

PROVENANCE = "provenance"
"""Key of the provenance in a JSON file of figures."""
CHANGED = "+changes"
"""Suffix of the commit where files that it holds are changed."""
COMMIT = "LIGHTPAGE_COMMIT"
_LONGEST_NAME = 250
"""Characters of what may be a file's name."""
_ALWAYS = ("command", "commit", "machine", "time", "inputs")


class Provenance(BaseModel):
    """Provenance of figures.

    Attributes:
        command: command that measured them.
        commit: commit of the source tree, empty without one.
        begun_at_commit: commit at which the work was begun, if another.
        machine: processor, cores, GPUs and system.
        time: time at which they were written, UTC, ISO 8601.
        inputs: SHA-256 of each file, folder or set of options that was measured on, by its name.
        source: origin of figures that the command did not write itself, and the reason why a part is not known.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    command: str = ""
    commit: str = ""
    begun_at_commit: str = ""
    machine: str = ""
    time: str = ""
    inputs: dict[str, str] = {}
    source: str = ""

    @property
    def unknown(self) -> list[str]:
        """Names of the parts that every command writes and that are missing here."""
        return [name for name in _ALWAYS if not getattr(self, name)]

    def to_json(self) -> dict[str, Any]:
        """Return the parts that are known."""
        return self.model_dump(exclude_defaults=True)


def provenance(**inputs: object) -> Provenance:
    """Return the provenance of what the running command measures now.

    Args:
        inputs: what it measures on: paths of files and folders, and values that JSON can hold.

    Raises:
        InvalidInputError, StorageError, SurroundingsError: a file cannot be read.
    """
    return Provenance(
        command=command(),
        commit=commit(),
        machine=machine(),
        time=f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}",
        inputs={name: digest(value) for name, value in inputs.items()},
    )


def write_figures(path: Path | None, figures: dict[str, Any], **inputs: object) -> None:
    """Write figures with their provenance, as `lightpage.files.write_json` and `provenance` do; nothing without a path.

    Args:
        path: path of the file.
        figures: figures by name.
        inputs: see `provenance`; the options of the running command where none is given, and the files among them.

    Raises:
        InvalidInputError, StorageError, SurroundingsError: a file cannot be read or written.
    """
    if path is not None:
        write_json(path, {**figures, PROVENANCE: provenance(**(inputs or _options(path))).to_json()})


def _options(out: Path) -> dict[str, object]:
    """Return the words of the running command, and the files among them."""
    paths = [Path(word.rpartition("=")[2]) for word in sys.argv[1:] if len(word) < _LONGEST_NAME]
    files = {path.name: path for path in paths if path != out and path.is_file()}
    return {"options": sys.argv[1:], **files}


def digest(value: object) -> str:
    """Return the SHA-256 of a file, of the names and contents of a folder, or of a value as JSON.

    Raises:
        InvalidInputError, StorageError, SurroundingsError: a file cannot be read.
    """
    if not isinstance(value, Path):
        return hashlib.sha256(json.dumps(value, sort_keys=True, default=str).encode()).hexdigest()
    if value.is_dir():
        return digest({path.relative_to(value).as_posix(): digest(path) for path in _files(value)})
    try:
        with value.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise os_failure(f"input {value}", error, "a file that can be read") from None


def _files(folder: Path) -> Iterator[Path]:
    return (path for path in sorted(folder.rglob("*")) if path.is_file())


def command() -> str:
    """Return the command that is running, with its arguments."""
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    program = Path(sys.argv[0]).name if spec is None else f"python -m {spec.name.removesuffix('.__main__')}"
    return f"{program} {shlex.join(sys.argv[1:])}".strip()


@cache
def machine() -> str:
    """Return the processor, the usable cores, the GPUs and the system, without the machine's name."""
    processor = (_values(Path("/proc/cpuinfo"), "model name") or [platform.processor()])[0]
    files = sorted(Path("/proc/driver/nvidia/gpus").glob("*/information"))
    gpus = [name for path in files for name in _values(path, "Model:")[:1]]
    return ", ".join([processor, f"{cores()} cores", *gpus, f"{platform.system()} {platform.machine()}"])


def _values(path: Path, key: str) -> list[str]:
    """Return the values behind a key in a file that the kernel makes; none where it lacks the file."""
    lines = path.read_text(errors="replace").splitlines() if path.exists() else []
    return [line.partition(":")[2].strip() for line in lines if line.startswith(key)]


@cache
def commit() -> str:
    """Return the commit of this source tree when first asked for, empty without one.

    What is committed while a process works is not what it runs. A copy of the tree without git is told its commit by
    the environment variable `LIGHTPAGE_COMMIT`.
    """
    if told := os.environ.get(COMMIT):
        return told
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
