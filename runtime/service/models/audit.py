"""The record of every change of models: who did what, when, and how it ended. It outlives the service."""

from __future__ import annotations

import json
import logging
import os
import threading
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from lightpage.files import sync_folder, synchronise
from lightpage.runtime.service.caller import NOBODY, Actor

AUDIT_BYTES = 10 << 20
"""Of a record of model changes before a new one is begun: some 40,000 changes."""
AUDIT_KEPT = 10
"""Earlier records that stay."""

_log = logging.getLogger(__name__)


class AuditLog:
    """Appends a line of JSON for each change to a file, and has it on the disk before `record` returns.

    A change that cannot be written down is logged, and goes on. A file that has become too large is put aside as
    `NAME.1`, the one before it as `NAME.2`, and so on. Its methods may be called from many threads.

    Args:
        path: the file, None for none: then changes are logged alone. Its folder is made if absent; one that
            goes later, as that of a disk that is taken out, is not made again.
        most_bytes: of the file.
        kept: files put aside that stay.
    """

    def __init__(self, path: Path | None = None, most_bytes: int = AUDIT_BYTES, kept: int = AUDIT_KEPT) -> None:
        self._path, self._most_bytes, self._kept = path, most_bytes, kept
        self._lock = threading.Lock()
        """Guards the file."""
        if path is not None:
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                path.open("ab").close()
            except OSError as error:
                _log.warning("model changes are not written down in %s: %s", path, error.strerror or error)

    def record(
        self, what: str, before: str, after: str, *, actor: Actor = NOBODY, outcome: str = "done", detail: str = ""
    ) -> None:
        """Write down a change, or one that did not come about; never raises for the disk's sake.

        Args:
            what: of `recalibrate`, `rollback`, `roll forward`, `activate`, `upload`, `pin`, `unpin`.
            before: version in service before.
            after: version that the change is about; after `done` of all but an upload and a pin it is in service.
            actor: who.
            outcome: `done`, or `failed`.
            detail: why it failed.
        """
        entry: dict[str, Any] = {
            "time": datetime.now(UTC).isoformat(timespec="milliseconds"),
            "what": what,
            "who": actor.name,
            "correlation_id": actor.correlation_id,
            "from": before,
            "to": after,
            "outcome": outcome,
        }
        if detail:
            entry["detail"] = detail
        level = logging.INFO if outcome == "done" else logging.WARNING
        why = f": {detail}" if detail else ""
        told = {"peer": actor.name, "correlation_id": actor.correlation_id, "method": what}
        change = f"from {before} to {after}" if after else f"of {before}"
        _log.log(level, "model change %s: %s, %s%s", what, change, outcome, why, extra={"told": told})
        if self._path is None:
            return
        line = json.dumps(entry, ensure_ascii=False).encode("utf-8", "replace") + b"\n"
        with self._lock:
            try:
                self._append(self._path, line)
            except OSError as error:
                _log.warning("model change not written down in %s: %s", self._path, error.strerror or error)

    def _append(self, path: Path, line: bytes) -> None:
        """Append a line, whole or not at all, and have it on the disk.

        Raises:
            OSError: the file cannot be written.
        """
        self._put_aside(path, len(line))
        with open(path, "ab", buffering=0) as file:
            size = os.fstat(file.fileno()).st_size
            is_new = not size
            try:
                if (written := file.write(line)) != len(line):
                    raise OSError(None, f"{written} of {len(line)} bytes written")
                synchronise(file.fileno())
            except OSError:
                with suppress(OSError):
                    file.truncate(size)
                raise
        if is_new:
            sync_folder(path.parent)

    def _put_aside(self, path: Path, more: int) -> None:
        """Begin a new file where the line does not fit any more."""
        if not path.exists() or path.stat().st_size + more <= self._most_bytes:
            return
        for number in range(self._kept - 1, 0, -1):
            with suppress(FileNotFoundError):
                path.with_name(f"{path.name}.{number}").replace(path.with_name(f"{path.name}.{number + 1}"))
        path.replace(path.with_name(f"{path.name}.1"))
        sync_folder(path.parent)
