"""A share of a bulk run: several processes, on one machine or on many, each do their own."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import islice

from lightpage.errors import InvalidInputError
from lightpage.runtime.archives.run.job import Job, Source
from lightpage.runtime.archives.run.task import Plain


class Part(Plain):
    """Every `count`th recording from `index`; of a fleet, every `count`th device with all its recordings.

    Attributes:
        index: from 0.
        count: how many parts there are.
    """

    index: int
    count: int

    @classmethod
    def parse(cls, text: str) -> Part:
        """A part as users write it: K/N.

        Raises:
            InvalidInputError: it is none.
        """
        match = re.fullmatch(r"([0-9]{1,6})/([0-9]{1,6})", text)
        if match is None or not int(match[1]) < int(match[2]):
            raise InvalidInputError("--part", repr(text), "K/N with K from 0 to N - 1")
        return cls(index=int(match[1]), count=int(match[2]))

    def sources(self, job: Job) -> Iterator[tuple[int, Source]]:
        """Its recordings, each with its place among the run's."""
        for place, own in self.devices(job):
            yield from enumerate(own, place)

    def devices(self, job: Job) -> Iterator[tuple[int, tuple[Source, ...]]]:
        """Recordings of each of its devices; see `lightpage.runtime.archives.run.job.Job.devices`."""
        return islice(job.devices.items(), self.index, None, self.count)

    def __str__(self) -> str:
        return f"{self.index}/{self.count}"


WHOLE = Part(index=0, count=1)
"""All of it."""
