"""JSON for machines: written whole or not at all, with null for what is not a number."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from optics.files import replace_text


def write_json(path: str | Path, data: Any) -> None:
    """Write `data` to `path`, replacing what is there in one step.

    Raises:
        InvalidInputError: the path cannot be written.
    """
    replace_text(path, json.dumps(_plain(data), indent=2, allow_nan=False) + "\n", "JSON file")


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
