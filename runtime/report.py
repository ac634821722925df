"""JSON for machines: written whole or not at all, with null for what is not a number."""

from __future__ import annotations

import json
import math
import os
import tempfile
from pathlib import Path
from typing import Any

from optics.errors import InvalidInputError


def write_json(path: str | Path, data: Any) -> None:
    """Write `data` to `path`, replacing what is there in one step.

    Raises:
        InvalidInputError: the path cannot be written.
    """
    path = Path(path)
    text = json.dumps(_plain(data), indent=2, allow_nan=False) + "\n"
    try:
        descriptor, name = tempfile.mkstemp(prefix=f".{path.name}-", dir=path.parent)
        try:
            with os.fdopen(descriptor, "w", encoding="utf-8") as file:
                file.write(text)
            os.chmod(name, 0o644)
            os.replace(name, path)
        except BaseException:
            os.unlink(name)
            raise
    except OSError as error:
        raise InvalidInputError(f"JSON file {path}", error, "a path that can be written") from None


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
