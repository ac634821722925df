"""Provenance of a training, which may be begun by one commit and finished by another."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from lightpage.files import replace_text
from lightpage.metrics.provenance import commit, provenance
from lightpage.run_files import BEGUN

_FIRST = "begun_by.json"


def provenance_of(folder: Path) -> dict[str, Any]:
    """Return the provenance of work that goes on in a folder, with the commit that it was begun with if another.

    Asked for before the work, it notes there who begins it.
    """
    path = folder / _FIRST
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        replace_text(path, json.dumps({"commit": commit()}) + "\n", "origin of a training")
    begun = json.loads(path.read_text("utf-8"))["commit"]
    options = {"options": folder / BEGUN} if (folder / BEGUN).exists() else {}
    now = provenance(**options)
    return now.model_copy(update={"begun_at_commit": "" if begun == now.commit else begun}).to_json()
