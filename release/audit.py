"""Asks an advisory database about every package of the locks, with pip-audit.

    python release/audit.py [LOCK ...]

Exit status 0: every package was looked up and none has a known vulnerability. 1: some have. 3: not all could be looked
up, so that nothing is known of the others. pip-audit itself ends with 0 where a database has never heard of a package,
which is also what it makes of an index without advisories.
"""

from __future__ import annotations

import json
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lock import LOCKS, read_lock

FOUND, UNKNOWN = 1, 3
_LONGEST_S = 600.0


def pins(lock: Path) -> list[str]:
    """NAME==VERSION of a lock's packages, without a local tag: databases know torch 2.13.0+cpu as 2.13.0."""
    return [f"{name}=={package.version.partition('+')[0]}" for name, package in read_lock(lock).items()]


def ask(packages: Sequence[str]) -> tuple[str, str]:
    """Run pip-audit on packages, and return its output and its stderr. It resolves and installs nothing."""
    words = ["--disable-pip", "--no-deps", "--progress-spinner", "off", "--format", "json"]
    with tempfile.NamedTemporaryFile("w", suffix=".txt") as file:
        file.writelines(f"{package}\n" for package in packages)
        file.flush()
        done = subprocess.run(
            [Path(sysconfig.get_path("scripts")) / "pip-audit", *words, "--requirement", file.name],
            capture_output=True,
            text=True,
            timeout=_LONGEST_S,
        )
    return done.stdout, done.stderr


def judged(packages: Sequence[str], printed: str, said: str) -> tuple[int, list[str]]:
    """Exit status for packages, and the lines to print."""
    try:
        rows: list[dict[str, Any]] = json.loads(printed)["dependencies"]
    except (json.JSONDecodeError, KeyError, TypeError):
        reason = said.strip().splitlines()[-1] if said.strip() else "pip-audit printed nothing"
        return UNKNOWN, [f"0 of {len(packages)} packages audited: {reason}"]
    audited = [row for row in rows if "skip_reason" not in row]
    lines = [
        f"{row['name']} {row['version']}: {found['id']}, mended in {', '.join(found['fix_versions']) or 'no version'}"
        for row in audited
        for found in row["vulns"]
    ]
    status = FOUND if lines else 0 if len(audited) == len(packages) else UNKNOWN
    lines.append(f"{len(audited)} of {len(packages)} packages audited")
    if skipped := [row for row in rows if "skip_reason" in row]:
        lines.append(f"not audited: {', '.join(row['name'] for row in skipped)}; {skipped[0]['skip_reason']}")
    return status, lines


def main(arguments: Sequence[str]) -> int:
    """Run the command that the head of the file describes."""
    locks = [Path(each) for each in arguments] or sorted(LOCKS.glob("*.txt"))
    statuses = set()
    for lock in locks:
        packages = pins(lock)
        status, lines = judged(packages, *ask(packages))
        print(*(f"{lock.name}: {line}" for line in lines), sep="\n")
        statuses.add(status)
    if FOUND in statuses:
        return FOUND
    if UNKNOWN in statuses:
        print("audit: not all packages could be looked up; this says nothing of them", file=sys.stderr)
        return UNKNOWN
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
