"""Frame sources by name: entry points of the group `lightpage.sources`, so that another package may bring its own."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from importlib.metadata import EntryPoint, entry_points

from lightpage.errors import InvalidInputError
from lightpage.runtime.device.acquisition.source import FrameSource


def open_source(spec: str, points: Iterable[EntryPoint] | None = None) -> FrameSource:
    """Open a source by its name.

    Args:
        spec: KIND:REST, e.g. ``recording:FILE``, or ``simulator:PROFILE`` (a shipped name or a file), which
            ``?levels=16&seed=0&device=FILE`` may follow.
        points: kinds of sources, by default those that are installed.

    Raises:
        InvalidInputError: another kind, or one whose recording, profile or device does not validate.
    """
    kinds = {point.name: point for point in (entry_points(group="lightpage.sources") if points is None else points)}
    kind, colon, rest = spec.partition(":")
    if not (colon and rest and kind in kinds):
        expected = f"KIND:REST, KIND being one of {', '.join(sorted(kinds))}, e.g. recording:FILE or simulator:PROFILE"
        raise InvalidInputError("source", repr(spec), expected)
    opener: Callable[[str], FrameSource] = kinds[kind].load()
    return opener(rest)
