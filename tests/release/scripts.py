"""The scripts of release/ as modules: they lie in no package, since they run where nothing is installed."""

import importlib
import sys
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).resolve().parents[2]


def script(name: str) -> ModuleType:
    """release/NAME.py, imported."""
    folder = str(ROOT / "release")
    if folder not in sys.path:
        sys.path.append(folder)
    return importlib.import_module(name)
