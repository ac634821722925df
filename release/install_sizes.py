"""Prints how many megabytes each installation of the README's table takes, beside what the table says.

    python release/install_sizes.py [PATTERN]

Each goes into an environment of its own, with the versions of constraints.txt. All files count but pip's own.
`PIP_FIND_LINKS` names a CPU build of torch.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
import venv
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
ROW = re.compile(r"^\| .* \| `'?(?P<asked>\.[^`']*)'?` \| (?P<megabytes>[\d,]+) \|", re.MULTILINE)


def stated() -> dict[str, int]:
    """Return the megabytes that the README states, by what pip is asked to install."""
    rows = ROW.finditer((ROOT / "README.md").read_text("utf-8"))
    return {row["asked"]: int(row["megabytes"].replace(",", "")) for row in rows}


def megabytes(asked: str) -> float:
    """Return the megabytes of an installation in a new environment.

    Raises:
        subprocess.CalledProcessError: pip failed, and has said why.
    """
    with tempfile.TemporaryDirectory(prefix="lightpage-") as folder:
        venv.create(folder)
        pip = [sys.executable, "-m", "pip", "--python", f"{folder}/bin/python", "install", "--quiet", "--no-compile"]
        subprocess.run([*pip, "--constraint", "constraints.txt", asked], cwd=ROOT, check=True)
        return sum(file.stat().st_size for file in _files(Path(folder, "lib"))) / 1e6


def _files(folder: Path) -> Iterator[Path]:
    return (path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())


def main() -> None:
    """Install and print."""
    wanted = sys.argv[1] if len(sys.argv) > 1 else ""
    for asked, said in stated().items():
        if wanted in asked:
            print(f"{asked:<20} {megabytes(asked):7,.0f} MB, README {said:,}", flush=True)


if __name__ == "__main__":
    main()
