"""The bundles that come with Lightpage, by name."""

import os
from importlib import resources
from pathlib import Path

from lightpage.errors import BundleError

DEFAULT = "bench"


def bundle_path(name_or_path: str) -> Path:
    """A shipped bundle's name, e.g. ``bench``, as the path where it was installed; any other path, e.g. ``./bench``.

    Raises:
        BundleError: a word that is neither.
    """
    path = Path(name_or_path)
    folder = Path(str(resources.files("lightpage.runtime.model.bundle"))) / "shipped_bundles"
    shipped = {bundle.stem: bundle for bundle in sorted(folder.glob("*.zip"))}
    if name_or_path in shipped:
        return shipped[name_or_path]
    if name_or_path == path.name and not path.suffix and not os.path.lexists(path):
        expected = f"a bundle's path, or the name of a shipped one: {', '.join(shipped)}"
        raise BundleError(f"bundle {name_or_path}", "no such file", expected)
    return path
