"""Processes of a bulk run as they look from outside: who they are, and how much memory they take."""

from __future__ import annotations

import resource
import threading
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Self


def children(process: int) -> list[int]:
    """Processes that a process has started, and that run."""
    try:
        return [int(word) for word in Path(f"/proc/{process}/task/{process}/children").read_text().split()]
    except OSError:
        return []


def with_mark(command: bytes, mark: str) -> list[int]:
    """Processes whose command line begins so, and whose environment has a mark."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            line, environment = ((folder / part).read_bytes() for part in ("cmdline", "environ"))
        except OSError:
            continue
        if line.startswith(command) and mark.encode() in environment:
            found.append(int(folder.name))
    return found


def resident_bytes(process: int) -> int:
    """Memory of a process; 0 of one that has ended."""
    try:
        return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * resource.getpagesize()
    except (OSError, IndexError):
        return 0


class Watch:
    """Notes every so often how much memory processes take; use it in a `with` statement.

    Args:
        who: the processes, by what they are.
        pages: how many pages are done.
        every_s: seconds between two looks.
    """

    def __init__(self, who: Callable[[], dict[str, list[int]]], pages: Callable[[], int], every_s: float = 0.5) -> None:
        self._who, self._pages, self._every_s = who, pages, every_s
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)
        self.seen: dict[tuple[str, int], list[tuple[int, int]]] = {}
        """Pages done and bytes, by what a process is and its number."""

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end.set()
        self._thread.join()

    def _look(self) -> None:
        while not self._end.wait(self._every_s):
            pages = self._pages()
            for name, processes in self._who().items():
                for process in processes:
                    if taken := resident_bytes(process):
                        self.seen.setdefault((name, process), []).append((pages, taken))

    def growth(self, after_pages: int) -> dict[str, float | None]:
        """Return the largest growth of a process since so many pages were done, relative to its size then, by kind.

        None where none was seen twice after them.
        """
        grown: dict[str, float | None] = {}
        for (name, _), looks in self.seen.items():
            later = [taken for pages, taken in looks if pages >= after_pages]
            share = max(later) / later[0] - 1 if len(later) > 1 else None
            before = grown.get(name)
            grown[name] = share if before is None else before if share is None else max(share, before)
        return grown
