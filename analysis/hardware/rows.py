"""Figures of pages, one JSON line each, kept as soon as they are measured."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

Rows = list[dict[str, Any]]


def kept_rows(path: Path) -> Rows:
    """The rows of a file, one a line; a line that was cut off at the end is dropped from the file too."""
    rows: Rows = []
    if path.exists():
        lines = path.read_text().splitlines(keepends=True)
        for line in lines:
            try:
                rows.append(json.loads(line))
            except ValueError:
                path.write_text("".join(lines[: len(rows)]))
                break
    return rows


def append_row(path: Path, row: dict[str, Any]) -> None:
    """Add a row to a file."""
    with path.open("a") as file:
        file.write(json.dumps(row) + "\n")
