"""The bundles that come with Lightpage, by name."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

DEFAULT = "bench"


def bundle_path(name_or_path: str) -> Path:
    """A shipped bundle's name, e.g. ``bench``, as the path where it was installed; any other path, e.g. ``./bench``."""
    path = Path(name_or_path)
    shipped = Path(str(resources.files("lightpage.runtime.model.bundle"))) / "shipped_bundles" / f"{name_or_path}.zip"
    return shipped if name_or_path == path.name and shipped.is_file() else path
