"""The bundles that come with Lightpage, by name."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

DEFAULT = "bench"


def bundle_path(name_or_path: str) -> Path:
    """A path as it is; a shipped bundle's name, e.g. ``bench``, as the path where it was installed."""
    path = Path(name_or_path)
    if path.exists() or path.name != name_or_path or path.suffix:
        return path
    shipped = Path(str(resources.files("runtime"))) / "bundles" / f"{name_or_path}.zip"
    return shipped if shipped.is_file() else path
