"""The finding: all that is told of a file."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from lightpage.cli.main import missing
from lightpage.device.profile import Profile
from lightpage.errors import LightpageError
from lightpage.foreign.array import readable

Picture = tuple[str, NDArray[Any], str]
"""Title, an array [row, column], and what its values are."""


@dataclass(frozen=True)
class Histogram:
    """Histogram of the counts in the frames that were looked at.

    Attributes:
        edges: first count of each bin, and the one after the last.
        shares: of the pixels in each bin.
        full_scale: greatest count that the bits in use hold.
        saturated: share of the pixels at full scale.
    """

    edges: tuple[int, ...]
    shares: tuple[float, ...]
    full_scale: int
    saturated: float


@dataclass(frozen=True)
class Fact:
    """A fact that people are told in other words than programs.

    Attributes:
        value: that JSON can hold.
        text: for people.
    """

    value: object
    text: str

    def __str__(self) -> str:
        return self.text


@dataclass
class Finding:
    """Facts and problems of a file; whoever looks at it adds to them.

    Attributes:
        path: of the file.
        kind: what it is, in a word or two.
        facts: what is to be told, by name.
        problems: what is wrong with it, or does not fit.
        next: commands that it is ready for.
        profile: of the device that it belongs to.
        histograms: of the counts of each camera, by name.
        pictures: opens what may be drawn of it.
    """

    path: Path
    kind: str
    facts: dict[str, object] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    next: list[str] = field(default_factory=list)
    profile: Profile | None = None
    histograms: dict[str, Histogram] = field(default_factory=dict)
    pictures: Callable[[], list[Picture]] | None = None

    @property
    def quoted(self) -> str:
        """The path as a shell takes it."""
        return shlex.quote(str(self.path))

    @contextmanager
    def trying(self, expected: str) -> Iterator[None]:
        """Note what goes wrong inside as a problem of the file, and go on."""
        try:
            with readable(f"{self.kind} {self.path}", expected):
                yield
        except LightpageError as error:
            self.problems.append(str(error))
        except ModuleNotFoundError as error:
            self.problems.append(str(missing(f"{self.kind} {self.path}", error)))

    def to_json(self) -> dict[str, object]:
        """Return all but the pictures, as JSON can hold it."""
        return {
            "path": printable(str(self.path)),
            "kind": self.kind,
            "facts": {_key(name): each.value if isinstance(each, Fact) else each for name, each in self.facts.items()},
            "problems": self.problems,
            "next": self.next,
            "profile": None if self.profile is None else self.profile.name,
            "histograms": {name: vars(each) for name, each in self.histograms.items()},
        }


def _key(name: str) -> str:
    """Return the name of a fact as programs read it, e.g. ``pages_looked_at``."""
    return re.sub(r"\W+", "_", name).strip("_")


def printable(text: str) -> str:
    """Return text for one line of a terminal: what is no character to be seen is escaped."""
    return "".join(sign if sign.isprintable() else ascii(sign)[1:-1] for sign in text)


def shape_fact(shape: tuple[int, ...]) -> Fact:
    """Return a shape as a fact."""
    return Fact(list(shape), shape_text(shape))


def shape_text(shape: tuple[int, ...]) -> str:
    """Return a shape for people."""
    return " x ".join(map(str, shape)) or "a single value"
