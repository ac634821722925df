"""The question of a bulk run, written into its folder once, so that the next run goes on with the same question."""

from __future__ import annotations

import glob
import hashlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Literal

from pydantic import ValidationError

from lightpage.errors import BundleError, InvalidInputError, LightpageError, RecordingError
from lightpage.failures import os_failure
from lightpage.files import check_utf8, replace_text
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.run.task import Choices, NamedBundle, Plain, Problem, Stamp
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.bundle.manifest import MANIFEST
from lightpage.runtime.model.bundle.shipped import bundle_path

FILE = "job.json"


class Source(Plain):
    """A recording of a run.

    Attributes:
        device: its name in the fleet; empty without a fleet.
        path: path of the file, absolute.
        bundle: place of its bundle among the run's.
        stamp: stamp of the file when the run began; None where it could not be opened.
        pages: pages that it has.
        problem: why it could not be opened, or why its device lacks what it needs; None where all is there.
        run: folder of the training run that its device's bundle was made from, where the fleet names it.
        given_up: whether it is lost for its problem, and not tried again.
    """

    device: str
    path: Path
    bundle: int
    stamp: Stamp | None = None
    pages: int = 0
    problem: Problem | None = None
    run: Path | None = None
    given_up: bool = False


class Job(Plain):
    """The question of a run.

    Attributes:
        format, version: format and version of this file.
        choices: how.
        bundles: what to decode with.
        sources: what to decode.
        rounds: bundles that pages which were not read well are read again with, in this order.
    """

    format: Literal["lightpage-bulk"] = "lightpage-bulk"
    version: Literal[1] = 1
    choices: Choices
    bundles: tuple[NamedBundle, ...]
    sources: tuple[Source, ...]
    rounds: tuple[NamedBundle, ...] = ()

    def write(self, folder: Path) -> None:
        """Write it into the folder of the run.

        Raises:
            InvalidInputError: it cannot be written.
        """
        replace_text(folder / FILE, self.model_dump_json(indent=1) + "\n", "job")

    @classmethod
    def read(cls, folder: Path) -> Job | None:
        """Read the question of a folder; None where no run has begun there.

        Raises:
            InvalidInputError: it cannot be read.
        """
        path = folder / FILE
        try:
            return cls.model_validate_json(path.read_bytes())
        except FileNotFoundError:
            return None
        except OSError as error:
            raise os_failure(f"job {path}", error, "a file that can be read") from None
        except ValidationError as error:
            expected = "what `lightpage bulk` of this version has written"
            raise InvalidInputError(f"job {path}", error, expected) from None

    def with_bundles_of(self, asked: Job) -> Job:
        """Return the job with bundles that could not be read before, or lie elsewhere now, from the same question."""
        now = {(source.device, source.path): asked.bundles[source.bundle] for source in asked.sources}
        places: dict[NamedBundle, int] = {}
        sources = []
        for source in self.sources:
            before = self.bundles[source.bundle]
            bundle = now.get((source.device, source.path), before)
            if before.sha256 and not bundle.sha256:  # it has gone since
                bundle = before
            sources.append(source.model_copy(update={"bundle": places.setdefault(bundle, len(places))}))
        return self.model_copy(update={"bundles": tuple(places), "sources": tuple(sources)})

    def looked_at_again(self, *, given_up: bool = False) -> Job:
        """Return the job after trying again recordings and bundles that could not be opened before.

        Args:
            given_up: whether recordings that were given up are tried too.
        """
        bundles, lacking = list(self.bundles), dict[int, Problem | None]()
        for place, bundle in enumerate(bundles):
            if not bundle.sha256:
                bundles[place], lacking[place] = bundle_as_it_is(bundle.path)
        again = (
            s
            if s.problem is None or (s.given_up and not given_up)
            else look_at(s.device, s.path, s.bundle, s.run, lacking=lacking.get(s.bundle))
            for s in self.sources
        )
        return self.model_copy(update={"bundles": tuple(bundles), "sources": tuple(again)})

    def passing(self) -> bool:
        """Return whether a recording or bundle could not be opened for a reason that may pass."""
        tried = (source.problem for source in self.sources if not source.given_up)
        return any(problem is not None and problem.passes for problem in tried)

    def unopened_given_up(self, places: Iterable[int]) -> Job:
        """Return the job without recordings that could not be opened, unless only their bundle is lacking.

        Args:
            places: places of the recordings that are meant.
        """
        sources = list(self.sources)
        for place in places:
            source = sources[place]
            if source.problem is not None and self.bundles[source.bundle].sha256:
                sources[place] = source.model_copy(update={"given_up": True})
        return self.model_copy(update={"sources": tuple(sources)})

    @property
    def devices(self) -> dict[int, tuple[Source, ...]]:
        """Recordings of each device of a fleet by the place of its first one; without a fleet each by itself.

        Those of a device are next to each other.
        """
        first: dict[str, int] = {}
        found: dict[int, tuple[Source, ...]] = {}
        for index, source in enumerate(self.sources):
            place = first.setdefault(source.device, index) if source.device else index
            found[place] = (*found.get(place, ()), source)
        return found

    def check_steps(self) -> None:
        """Check that a bundle of the run has as many Gauss-Newton steps as are chosen; others do with fewer.

        Raises:
            InvalidInputError: none has; the error is that of the first bundle.
        """
        from lightpage.runtime.model.execution.page_graph import (
            check_steps,
        )  # a finished run loads nothing that decodes

        refusals = []
        for named in (*self.bundles, *self.rounds):
            try:
                check_steps(Bundle.open(named.path), self.choices.steps)
                return
            except InvalidInputError as error:
                refusals.append(error)
            except BundleError:
                continue  # whoever decodes with it tells why it cannot be read
        if refusals:
            raise refusals[0]

    def check(self, folder: Path, asked: Job) -> None:
        """Check that a run asks what was asked before; files that have gone or changed are the workers' to tell.

        Raises:
            InvalidInputError: it asks something else.
        """
        subject, expected = f"bulk run {folder}", "the same question, or another folder"
        for name, before in vars(self.choices).items():
            if (now := getattr(asked.choices, name)) != before:
                raise InvalidInputError(f"{subject}: {name}", f"{now}, and {before} before", expected)
        before_paths = {(s.device, s.path): self.bundles[s.bundle] for s in self.sources}
        runs = {source.device: source.run for source in self.sources}
        for source in asked.sources:
            bundle = before_paths.pop((source.device, source.path), None)
            if self.choices.fine_tuning is not None and (run := runs.get(source.device)) != source.run:
                got = f"{source.run}, and {run} before"
                raise InvalidInputError(f"{subject}: run of {source.device}", got, expected)
            if bundle is None:
                raise InvalidInputError(subject, f"recording {source.path}, which was not asked for before", expected)
            now = asked.bundles[source.bundle]
            if bundle.sha256 and now.sha256 and now.sha256 != bundle.sha256:
                got = f"{now.version} ({now.sha256[:12]}), and {bundle.version} ({bundle.sha256[:12]}) before"
                raise InvalidInputError(f"{subject}: bundle", got, f"{expected}; --again-with reads anew what was lost")
        if left_out := [str(path) for _, path in before_paths if path.exists()]:
            raise InvalidInputError(subject, f"no recording {left_out[0]}, which was asked for before", expected)


def bundle_sha256(path: Path) -> str:
    """SHA-256 of a bundle that is a zip; of a folder, that of its manifest, which names those of its files.

    Raises:
        BundleError: it cannot be read.
    """
    try:
        with _told_by(path).open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise os_failure(f"bundle {path}", error, "a bundle that can be read", BundleError) from None


def named_bundle(name_or_path: str) -> NamedBundle:
    """A bundle as a run names it.

    Raises:
        BundleError: it is none.
        InvalidInputError: its name is not UTF-8.
    """
    path = bundle_path(name_or_path).absolute()
    check_utf8(path, "--bundle")
    return _named(path)


def bundle_as_it_is(path: Path, known: Mapping[Path, NamedBundle] | None = None) -> tuple[NamedBundle, Problem | None]:
    """A bundle of a fleet, without SHA-256 and version where it cannot be read, and why.

    Args:
        path: path of the bundle, absolute.
        known: bundles as they were before; one whose file is as it was is not read again.
    """
    try:
        return _named(path, known.get(path) if known else None), None
    except LightpageError as error:
        return NamedBundle(path=path, sha256="", version=""), Problem.of(error)


def _named(path: Path, before: NamedBundle | None = None) -> NamedBundle:
    try:
        stamp = Stamp.of(_told_by(path))
    except OSError:
        stamp = None  # whoever reads it tells why
    if before is not None and stamp is not None and before.stamp == stamp:
        return before
    return NamedBundle(path=path, sha256=bundle_sha256(path), version=Bundle.open(path).version, stamp=stamp)


def _told_by(bundle: Path) -> Path:
    """The file whose contents say what a bundle is."""
    return bundle / MANIFEST if bundle.is_dir() else bundle


def look_at(
    device: str,
    path: Path,
    bundle: int,
    run: Path | None = None,
    known: Mapping[tuple[str, Path], Source] | None = None,
    lacking: Problem | None = None,
) -> Source:
    """A recording as it is now, or as it is known.

    One that cannot be opened is kept with its problem, or with what its bundle is `lacking`.
    """
    found = Source(device=device, path=path, bundle=bundle, run=run, problem=lacking)
    if lacking is not None:
        return found
    if known and (source := known.get((device, path))) is not None:
        return source.model_copy(update={"bundle": bundle, "run": run})
    try:
        stamp = Stamp.of(path)
        with Recording.open(path) as recording:
            return found.model_copy(update={"stamp": stamp, "pages": recording.pages})
    except LightpageError as error:
        problem = Problem.of(error)
    except FileNotFoundError as error:
        pattern = glob.has_magic(str(path))
        got = "no file when the run began" if pattern else error
        expected = "files that are there; begin another run for this device" if pattern else "a recording"
        problem = Problem.of(RecordingError(f"recording {path}", got, expected))
    except OSError as error:
        problem = Problem.of(os_failure(f"recording {path}", error, "a recording", RecordingError))
    return found.model_copy(update={"problem": problem})
