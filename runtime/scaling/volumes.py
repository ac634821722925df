"""The files of a run that recovers user bytes: pages are gathered from the shards, and parity mends what is lost."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lightpage.codec.volume import Volume
from lightpage.codec.volume_file import VolumeFile, ranges
from lightpage.errors import InvalidInputError, LostDataError
from lightpage.files import write_json
from runtime.scaling.job import Job
from runtime.scaling.ledger import Ledger
from runtime.scaling.shard import read_user_bytes

FOLDER, TOLD = "files", "files.json"
"""Of a run's folder: the files that are whole, and what became of each at the end of the last run."""


@dataclass(frozen=True)
class RecoveredFile:
    """A volume, and what became of its file.

    Attributes:
        volume: how it lies on its pages.
        path: where the file is, if it is whole.
        read: pages that gave bytes, parity pages included.
        restored, lost: see `lightpage.codec.volume_file.Restored`.
        error: why there is no file; None where there is.
    """

    volume: Volume
    path: Path
    read: int
    restored: tuple[int, ...] = ()
    lost: tuple[int, ...] = ()
    error: str | None = None

    def to_json(self) -> dict[str, Any]:
        """The figures under the names that other programs read."""
        return {
            **self.volume.to_json(),
            "file": str(self.path) if self.error is None else None,
            "pages_read": self.read,
            "restored": list(self.restored),
            "lost": list(self.lost),
            "error": self.error,
        }


def recovered_files(ledger: Ledger, job: Job) -> list[RecoveredFile]:
    """Make the file of every volume whose pages suffice, and note what became of each; one that is there stays.

    Of the shards one is held at a time, and of the volumes their names.

    Raises:
        InvalidInputError: a shard cannot be read, or a file cannot be written.
    """
    shards: dict[Volume, dict[Path, int]] = {}
    for shard in _shards(ledger, job):
        for _, page in read_user_bytes(shard):
            if (volume := Volume.of_page(page)) is not None:
                there = shards.setdefault(volume, {})
                there[shard] = there.get(shard, 0) + 1
    before = {file["file"]: tuple(file["restored"]) for file in known_files(ledger.folder) or ()}
    files = [_file(ledger.folder / FOLDER, volume, there, before) for volume, there in shards.items()]
    write_json(ledger.folder / TOLD, [file.to_json() for file in files])
    return files


def known_files(folder: Path) -> list[dict[str, Any]] | None:
    """What became of the files of a run at the end of its last run; None where none has ended.

    Raises:
        InvalidInputError: it cannot be read.
    """
    path = folder / TOLD
    try:
        found: list[dict[str, Any]] = json.loads(path.read_bytes())
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise InvalidInputError(f"files {path}", error, "what a bulk run has written; delete it") from None
    return found


def _shards(ledger: Ledger, job: Job) -> list[Path]:
    found = []
    for index, source in enumerate(job.sources):
        there = ledger.results(index)
        for task in ledger.ranges(job, index, source):
            readings = [ledger.shard(index, task.pages[0], number) for number in range(1 + len(job.rounds))]
            found += [shard for shard in readings if shard.name in there]
    return found


def _file(folder: Path, volume: Volume, shards: dict[Path, int], before: dict[str, tuple[int, ...]]) -> RecoveredFile:
    path, read = folder / f"{volume.id}-{volume.checksum:08x}", sum(shards.values())
    if path.exists():
        return RecoveredFile(volume, path, read, before.get(str(path), ()))
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise InvalidInputError(f"folder {folder}", error, "a folder that can be written") from None
    file = VolumeFile(path, volume)
    try:
        for shard in shards:
            for _, page in read_user_bytes(shard):
                if Volume.of_page(page) == volume and page.header is not None and page.data is not None:
                    file.add(page.header.page, page.data)
        done = file.restore()
        if done.lost:
            told = f"data pages {ranges(done.lost)} lost, no file; at most {volume.parity_pages} lost pages a group"
            return RecoveredFile(volume, path, read, done.restored, done.lost, told)
        file.complete()
        return RecoveredFile(volume, path, read, done.restored)
    except (LostDataError, InvalidInputError) as error:
        return RecoveredFile(volume, path, read, error=str(error))
    finally:
        file.close()
