"""Processes that this one, or one of its children, has started."""

from pathlib import Path


def runs(process: int) -> bool:
    """Return whether a process has not ended."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def children(parent: int, module: str) -> list[int]:
    """Running processes of a module that a process has started; they go by its name once they have begun."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            above = (folder / "stat").read_text().rpartition(")")[2].split()[1]
            command = (folder / "cmdline").read_bytes()
        except OSError:
            continue
        if int(above) == parent and module.encode() in command and runs(int(folder.name)):
            found.append(int(folder.name))
    return found
