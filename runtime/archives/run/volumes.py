"""The files of a run that recovers user bytes: pages are gathered from the shards, and parity mends what is lost."""

import json
from collections import Counter, defaultdict
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lightpage.codec.volume import Volume
from lightpage.codec.volume_file import PARTIAL, Restored, VolumeFile, ranges
from lightpage.errors import InvalidInputError, LostDataError, StorageError, SurroundingsError
from lightpage.failures import may_pass
from lightpage.files import write_json
from lightpage.runtime.archives.run.job import Job
from lightpage.runtime.archives.run.ledger import Ledger, make_folder
from lightpage.runtime.archives.run.shard import read_user_bytes

FOLDER, TOLD, HOLES = "files", "files.json", ".holes"
"""Of a run's folder: the files, what became of each at the end of the last run, and the end of a name with holes."""


@dataclass(frozen=True)
class Wanted:
    """Choice of the files to make.

    Attributes:
        volume_id, checksum: number and checksum of one volume alone; None for any.
        holes: whether a file is made too where data are lost, with zeros in their place and `HOLES` behind its name.
    """

    volume_id: int | None = None
    checksum: int | None = None
    holes: bool = False

    def takes(self, volume: Volume) -> bool:
        """Return whether a volume's file is made."""
        return self.volume_id in (None, volume.id) and self.checksum in (None, volume.checksum)

    def __str__(self) -> str:
        return f"{self.volume_id}" + ("" if self.checksum is None else f":{self.checksum:08x}")


ALL_FILES = Wanted()


@dataclass(frozen=True)
class RecoveredFile:
    """A volume, and what became of its file.

    Attributes:
        volume: how it lies on its pages.
        path: where the file is, if it is whole, or would be.
        read: pages that gave bytes, parity pages included.
        restored, lost: see `lightpage.codec.volume_file.Restored`.
        error: why there is no whole file; None where there is.
        holes: the file with zeros where data are lost; None where none was made.
        passes: whether another try to write it may go well.
    """

    volume: Volume
    path: Path
    read: int
    restored: tuple[int, ...] = ()
    lost: tuple[int, ...] = ()
    error: str | None = None
    holes: Path | None = None
    passes: bool = False

    def to_json(self) -> dict[str, Any]:
        """The figures under the names that other programs read."""
        return {
            **self.volume.to_json(),
            "file": str(self.path) if self.error is None else None,
            "pages_read": self.read,
            "restored": list(self.restored),
            "lost": list(self.lost),
            "error": self.error,
            "file_with_holes": None if self.holes is None else str(self.holes),
        }


def recovered_files(ledger: Ledger, job: Job, wanted: Wanted = ALL_FILES) -> list[RecoveredFile]:
    """Make the files of volumes whose pages suffice, and note what became of each; one that is there stays.

    Of the shards one is held at a time, and of the volumes their names. No other process may make them meanwhile.

    Raises:
        InvalidInputError: a shard cannot be read, a file cannot be written, or no page is of the volume that is wanted.
    """
    for left in (ledger.folder / FOLDER).glob(f"*{PARTIAL}"):  # of a run that was killed
        left.unlink(missing_ok=True)
    shards: defaultdict[Volume, Counter[Path]] = defaultdict(Counter)
    seen: set[Volume] = set()
    for shard in _shards(ledger, job):
        for _, page in read_user_bytes(shard):
            if (volume := Volume.of_page(page)) is not None:
                seen.add(volume)
                if wanted.takes(volume):
                    shards[volume][shard] += 1
    known = known_files(ledger.folder) or []
    before = {file["file"]: tuple(file["restored"]) for file in known}
    if seen and not shards:
        shown = ", ".join(f"{volume.id}:{volume.checksum:08x}" for volume in seen)
        raise InvalidInputError("--volume", str(wanted), f"a volume of the recordings: {shown}")
    files = [_file(ledger.folder / FOLDER, volume, there, before, wanted.holes) for volume, there in shards.items()]
    told = [file.to_json() for file in files]
    asked = {(volume.id, volume.checksum) for volume in shards}
    others = [file for file in known if (file["volume"], file["checksum"]) not in asked]
    write_json(ledger.folder / TOLD, [*others, *told])
    return files


def known_files(folder: Path) -> list[dict[str, Any]] | None:
    """Return what became of the files of a run at the end of its last run; None where none has ended.

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
    found: list[Path] = []
    for index, source in enumerate(job.sources):
        there = ledger.results(index)
        for task in ledger.ranges(job, index, source):
            found += ledger.readings(index, task.pages[0], there, 1 + len(job.rounds)).values()
    return found


def _file(
    folder: Path, volume: Volume, shards: dict[Path, int], before: dict[str, tuple[int, ...]], holes: bool
) -> RecoveredFile:
    path, read = folder / f"{volume.id}-{volume.checksum:08x}", sum(shards.values())
    if path.exists():
        return RecoveredFile(volume, path, read, before.get(str(path), ()))
    make_folder(folder)
    try:
        done = _written(path, volume, shards, despite_losses=False)
        # under a name of its own: whoever finds the other one may take it for whole
        beside, made = path.with_name(path.name + HOLES), "no file"
        if not done.lost:
            beside.unlink(missing_ok=True)
            return RecoveredFile(volume, path, read, done.restored)
        if holes:
            _written(beside, volume, shards, despite_losses=True)
            made = f"zeros in {beside}"
        told = f"data pages {ranges(done.lost)} lost, {made}; at most {volume.parity_pages} lost pages a group"
        return RecoveredFile(volume, path, read, done.restored, done.lost, told, beside if beside.exists() else None)
    except (LostDataError, InvalidInputError, StorageError, SurroundingsError) as error:
        return RecoveredFile(volume, path, read, error=str(error), passes=may_pass(error))


def _written(path: Path, volume: Volume, shards: dict[Path, int], *, despite_losses: bool) -> Restored:
    """Put a file together, and give it its name unless data are lost; raises as `VolumeFile` does."""
    with closing(VolumeFile(path, volume)) as file:
        for shard in shards:
            for _, page in read_user_bytes(shard):
                if Volume.of_page(page) == volume and page.header is not None and page.data is not None:
                    file.add(page.header.page, page.data)
        done = file.restore()
        if despite_losses or not done.lost:
            file.complete(done.lost)
        return done
