"""Results of a benchmark, kept part by part: what is there is not measured again, and nothing is begun too late."""

from __future__ import annotations

import json
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from lightpage.clock import SYSTEM, Clock
from lightpage.errors import InvalidInputError
from lightpage.files import write_json
from lightpage.metrics.provenance import PROVENANCE, commit

PARTS, SECONDS = "parts", "seconds"
_LONGER = 1.5
"""Time of a part over the longest of done ones of its kind: the slowest preset over the one in the middle."""


class Kept:
    """Results in a file, part by part, measured within a time that bounds the whole.

    A part is named `WHAT, KIND` or `KIND`; parts of one kind take about the same time.

    Args:
        path: path of the file.
        head: what is said once: `card` at least.
        seconds: time that all of this run may take.
        clock: clock by which they pass.

    Attributes:
        path, whole: path and contents of the file.
        left_out: parts that were not begun.

    Raises:
        InvalidInputError: the file's results are of another card or another commit.
    """

    def __init__(self, path: Path, head: Mapping[str, Any], seconds: float, clock: Clock = SYSTEM) -> None:
        self.path, self._clock, self._end, self.left_out = path, clock, clock.now() + seconds, list[str]()
        self.whole: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
        self.whole = {PARTS: {}, SECONDS: {}} | self.whole
        for name, now in (("card", head["card"]), ("commit", commit())):  # of two cards or programs nothing is mixed
            before = (self.whole if name in head else self.whole.get(PROVENANCE, {})).get(name, now)
            if before != now:
                raise InvalidInputError(f"{path}: {name}", before, f"{now}, or another folder")
        self.whole |= dict(head)

    @property
    def parts(self) -> dict[str, Any]:
        """Results by part."""
        parts: dict[str, Any] = self.whole[PARTS]
        return parts

    @property
    def left_s(self) -> float:
        """Time that is left."""
        return self._end - self._clock.now()

    def expected_s(self, name: str, usual_s: float) -> float:
        """Time that a part is expected to take: the usual one, or more where done parts of its kind took longer."""
        done: dict[str, float] = self.whole[SECONDS]
        alike = [done[other] for other in done if other.rpartition(", ")[2] == name.rpartition(", ")[2]]
        return max(usual_s, done.get(name, _LONGER * max(alike, default=0.0)))

    def fits(self, name: str, usual_s: float) -> bool:
        """Return whether a part can end in time, and say so where it cannot."""
        if (expected := self.expected_s(name, usual_s)) <= self.left_s:
            return True
        self.left_out.append(name)
        click.echo(f"{name}: not begun, as it takes {expected:.0f} s and {self.left_s:.0f} s are left", err=True)
        return False

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Note how long a part takes, for estimates of others."""
        begun = self._clock.now()
        yield
        self.whole[SECONDS][name] = self._clock.now() - begun

    def part(self, name: str, usual_s: float, measure: Callable[[], Any]) -> Any:
        """A part, measured now unless it is there.

        Args:
            name: name of the part.
            usual_s: time that it takes as far as is known.
            measure: gives the part, as JSON can hold it; a failure is told, and tried again the next time.

        Returns:
            The part, or None where it failed or cannot end in time.
        """
        if name in self.parts:
            return self.parts[name]
        if not self.fits(name, usual_s):
            return None
        try:
            with self.timed(name):
                found = measure()
        except Exception as error:
            traceback.print_exc(limit=5)
            click.echo(f"{name}: failed, {error}"[:300], err=True)
            self.left_out.append(name)
            return None
        self.parts[name] = found
        write_json(self.path, self.whole)
        click.echo(f"{name} ({self.whole[SECONDS][name]:.1f} s): {json.dumps(found)[:2000]}", err=True)
        return found
