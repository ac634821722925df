"""The folder in which a service keeps the bundles that it made, and remembers across restarts which one it used."""

from __future__ import annotations

import json
import logging
from collections.abc import Collection
from pathlib import Path

from lightpage.errors import BundleError, InvalidInputError
from lightpage.files import replace_text
from runtime.bundle.bundle import Bundle
from runtime.bundle.manifest import MANIFEST, sha256

_log = logging.getLogger(__name__)

CURRENT = "current.json"

KEPT_BUNDLES = 32
"""Bundles kept: a device that recalibrates itself for years shall not fill its disk, yet leave a trail to follow."""


class ModelStore:
    """A folder of bundles descended from one base bundle.

    Args:
        folder: made if absent.
        base: the bundle that the operator gave; another base has its own memory.
        kept: how many of the newest bundles `prune` leaves.

    Raises:
        BundleError: the folder cannot be made or written.
    """

    def __init__(self, folder: Path, base: Bundle, kept: int = KEPT_BUNDLES) -> None:
        self.folder, self._kept = folder, kept
        self._base = sha256(base.manifest.to_json())
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise BundleError(f"model store {folder}", error, "a folder that can be written") from None

    def path_of(self, version: str) -> Path:
        """Where the bundle of this version is or will be."""
        return self.folder / f"{version}.zip"

    def versions(self) -> list[str]:
        """Versions that exist here."""
        return sorted(path.name.removesuffix(".zip") for path in self.folder.glob("*.zip"))

    def prune(self, held: Collection[Path]) -> list[Path]:
        """Delete all but the newest bundles and those `held`; returns what was deleted."""
        newest_first = sorted(self.folder.glob("*+r*.zip"), key=lambda path: path.stat().st_mtime_ns, reverse=True)
        dropped = [path for path in newest_first[self._kept :] if path not in held]
        for path in dropped:
            path.unlink(missing_ok=True)
        return dropped

    def remember(self, path: Path | None) -> None:
        """Note which bundle is in service, None standing for the base; a crash or power cut leaves one note, whole.

        Raises:
            BundleError: the note cannot be written.
        """
        note = {"base": self._base, "bundle": path.name if path is not None else None}
        try:
            replace_text(self.folder / CURRENT, json.dumps(note))
        except InvalidInputError as error:
            raise BundleError(f"model store {self.folder}", error.got, "a folder that can be written") from None

    def last(self) -> Path | None:
        """The bundle that was in service when the program ended, None standing for the base.

        None too without a note or with another base's, and, with a warning, where the note or its bundle is lost.
        """
        try:
            return self._noted()
        except BundleError as error:
            _log.warning("serving the base: %s", error)
            return None

    def _noted(self) -> Path | None:
        subject = f"model store {self.folder}"
        try:
            note = json.loads((self.folder / CURRENT).read_text("utf-8"))
            name, base = note["bundle"], note["base"]
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise BundleError(f"{subject}: {CURRENT}", repr(error), "a note that can be read") from None
        if base != self._base or name is None:
            return None
        if not isinstance(name, str) or Path(name).name != name or name == MANIFEST:
            raise BundleError(f"{subject}: {CURRENT}", repr(name), "the name of a bundle")
        path = self.folder / name
        if not path.is_file():
            raise BundleError(f"{subject}: {name}", "no such file", "the bundle that was in service")
        return path
