"""A virtual environment for each of the other servers: they ask for versions that exclude those of Lightpage."""

from __future__ import annotations

import hashlib
import shutil
import subprocess
import sys
from importlib import resources
from pathlib import Path

from lightpage.errors import LightpageError
from lightpage.progress import note

NAMES = ("mlserver", "kserve", "ray")
_INSTALL_S = 1800.0
_LAST_LINES = 2000


def requirements(name: str) -> str:
    """The pinned packages of an environment, one a line."""
    return resources.files(__package__).joinpath(f"{name}.txt").read_text("utf-8")


def environment(folder: Path, name: str) -> Path:
    """Install a server's environment in FOLDER/NAME unless one with the same requirements is there; return its Python.

    Raises:
        LightpageError: it cannot be installed.
    """
    home = folder / name
    python, stamp = home / "bin" / "python", home / "installed"
    wanted = requirements(name)
    version = hashlib.sha256(f"{sys.version_info[:2]}\n{wanted}".encode()).hexdigest()
    if stamp.is_file() and stamp.read_text("utf-8") == version:
        return python
    note(f"installing {name} into {home}")
    shutil.rmtree(home, ignore_errors=True)
    home.mkdir(parents=True)
    listed = home / "requirements.txt"
    listed.write_text(wanted, "utf-8")
    _run([sys.executable, "-m", "venv", str(home)], name)
    _run([str(python), "-m", "pip", "install", "--quiet", "--no-deps", "--requirement", str(listed)], name)
    _run([str(python), "-m", "pip", "check"], name)
    stamp.write_text(version, "utf-8")
    return python


def _run(command: list[str], name: str) -> None:
    try:
        run = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=_INSTALL_S, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise LightpageError(f"environment {name}", error, "its packages installed") from None
    if run.returncode != 0:
        got = (run.stdout + run.stderr)[-_LAST_LINES:].strip()
        raise LightpageError(f"environment {name}: {' '.join(command)}", got, "its packages installed")
