"""What a bulk run was asked: written into its folder once, so that the next run goes on with the same question."""

from __future__ import annotations

import glob
import hashlib
import os
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Literal

from pydantic import Field, ValidationError

from lightpage.codec.code import Code
from lightpage.errors import BundleError, InvalidInputError, LightpageError, RecordingError
from lightpage.failures import os_failure
from lightpage.files import check_utf8, matching, read_text, replace_text
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.run.task import FineTuning, NamedBundle, Operation, Plain, Problem, Stamp
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.bundle.manifest import MANIFEST
from lightpage.runtime.model.bundle.shipped import bundle_path
from lightpage.runtime.model.execution.providers import CPU

FILE = "job.json"

RANGE_PAGES = 32
"""Of a range, unless told otherwise: what a worker that dies costs at most, and often enough that its first page, whose
image is looked for, costs little."""

KNOWN_PAGES = 2
"""Pages that a device is recalibrated with, unless told otherwise."""


class Source(Plain):
    """A recording of a run.

    Attributes:
        device: its name in the fleet; empty without a fleet.
        path: of the file, absolute.
        bundle: place of its bundle among the run's.
        stamp: of the file when the run began; None where it could not be opened.
        pages: that it has.
        problem: why it could not be opened, or why its device lacks what it needs; None where all is there.
        run: folder of the training run that its device's bundle was made from, where the fleet names it.
        given_up: whether it is lost for its problem, and not tried again.
    """

    device: str
    path: Path
    bundle: int
    stamp: Stamp | None
    pages: int
    problem: Problem | None = None
    run: Path | None = None
    given_up: bool = False


class Choices(Plain):
    """What is asked beside recordings and bundles.

    Attributes:
        operation: what is done.
        range_pages: pages of a range.
        tracking: whether the image is followed within a range.
        symbols: whether decoding keeps symbols and confidences.
        code: of the pages whose user bytes are read; None for each recording's, or else its bundle's.
        provider: what pages are computed with.
        known_pages: that a device is recalibrated with; None for `KNOWN_PAGES`, or all of them with `fine_tuning`.
        fine_tuning: how devices are trained on after the fit of their geometry; None to fit the geometry alone.
        parts: that processes do independently of each other.
    """

    operation: Operation
    range_pages: int = RANGE_PAGES
    tracking: bool = True
    symbols: bool = True
    code: Code | None = None
    provider: str = CPU
    known_pages: int | None = None
    fine_tuning: FineTuning | None = None
    parts: int = 1

    @property
    def device_pages(self) -> int | None:
        """Known pages that a device is recalibrated with; None for all that it has."""
        return self.known_pages or (KNOWN_PAGES if self.fine_tuning is None else None)


class Job(Plain):
    """What a run was asked.

    Attributes:
        format, version: of this file.
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
        """That of a folder; None where no run has begun there.

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
        """The same; bundles that could not be read before, or lie elsewhere now, are taken from the same question."""
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
        """The same; recordings and bundles that could not be opened before are tried once more.

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
        """Whether a recording or bundle could not be opened for a reason that may pass."""
        tried = (source.problem for source in self.sources if not source.given_up)
        return any(problem is not None and problem.passes for problem in tried)

    def unopened_given_up(self, places: Iterable[int]) -> Job:
        """The same; recordings that could not be opened are given up, unless it is their bundle that is lacking.

        Args:
            places: of the recordings that are meant.
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

    def checked(
        self,
        devices: Iterable[tuple[int, tuple[Source, ...]]],
        check: Callable[[int, tuple[Source, ...], Path], None],
    ) -> Job:
        """The same; of these devices, one that `check` refuses has a problem.

        Args:
            devices: of `devices`, places and recordings.
            check: is given the place, recordings and bundle's path of each that has none yet.
        """
        sources = list(self.sources)
        for place, own in devices:
            if any(source.problem is not None for source in own):
                continue
            try:
                check(place, own, self.bundles[own[0].bundle].path)
            except LightpageError as error:
                sources[place] = own[0].model_copy(update={"problem": Problem.of(error)})
        return self.model_copy(update={"sources": tuple(sources)})

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
                raise InvalidInputError(
                    f"{subject}: run of {source.device}", f"{source.run}, and {run} before", expected
                )
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
        path: of it, absolute.
        known: bundles as they were before; one whose file is as it was is not read again.
    """
    before = known.get(path) if known else None
    if before is not None and before.stamp is not None and before.stamp == _stamp(path):
        return before, None
    try:
        return _named(path), None
    except LightpageError as error:
        return NamedBundle(path=path, sha256="", version=""), Problem.of(error)


def _named(path: Path) -> NamedBundle:
    stamp, sha256 = _stamp(path), bundle_sha256(path)
    return NamedBundle(path=path, sha256=sha256, version=Bundle.open(path).version, stamp=stamp)


def _stamp(bundle: Path) -> Stamp | None:
    try:
        return Stamp.of(_told_by(bundle))
    except OSError:
        return None


def _told_by(bundle: Path) -> Path:
    """The file whose contents say what a bundle is."""
    return bundle / MANIFEST if bundle.is_dir() else bundle


def found_recordings(patterns: Sequence[str], folder: Path | None = None) -> list[Path]:
    """Files that the patterns name, each once, sorted within a pattern.

    A file that has a pattern for its name, brackets and all, is meant by it.

    Args:
        patterns: names, or patterns of `glob`; ``~`` is the home folder where nothing has that name.
        folder: that they are relative to; by default the working folder.

    Raises:
        InvalidInputError: a pattern that names none, or a name that is not UTF-8.
    """
    found: dict[Path, None] = {}
    base = Path.cwd() if folder is None else folder.absolute()
    for pattern in patterns:
        asked = pattern if os.path.lexists(base / pattern) else os.path.expanduser(pattern)
        names = matching(str(base / asked)) or ([asked] if not glob.has_magic(asked) else [])
        if not names:
            raise InvalidInputError(f"--recordings {pattern}", "no file", "a pattern of files that are there")
        found |= dict.fromkeys(base / name for name in names)
    for path in found:
        check_utf8(path, "--recordings")
    return list(found)


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
    if lacking is not None:
        return Source(device=device, path=path, bundle=bundle, stamp=None, pages=0, problem=lacking, run=run)
    if known and (source := known.get((device, path))) is not None:
        return source.model_copy(update={"bundle": bundle, "run": run})
    try:
        stamp = Stamp.of(path)
        with Recording.open(path) as recording:
            return Source(device=device, path=path, bundle=bundle, stamp=stamp, pages=recording.pages, run=run)
    except LightpageError as error:
        problem = Problem.of(error)
    except FileNotFoundError as error:
        pattern = glob.has_magic(str(path))
        got = "no file when the run began" if pattern else error
        expected = "files that are there; begin another run for this device" if pattern else "a recording"
        problem = Problem.of(RecordingError(f"recording {path}", got, expected))
    except OSError as error:
        problem = Problem.of(os_failure(f"recording {path}", error, "a recording", RecordingError))
    return Source(device=device, path=path, bundle=bundle, stamp=None, pages=0, problem=problem, run=run)


def of_recordings(choices: Choices, patterns: Sequence[str], bundle: str, before: Job | None) -> Job:
    """A run over recordings of one device, or of devices that share a bundle.

    Args:
        choices: how.
        patterns: of the recordings' names.
        bundle: a path, or the name of a shipped one.
        before: what the folder was asked before; recordings that are in it are not opened.

    Raises:
        LightpageError: no such bundle, or no such files.
    """
    known = _known(before)
    sources = tuple(look_at("", path, 0, known=known) for path in found_recordings(patterns))
    return Job(choices=choices, bundles=(named_bundle(bundle),), sources=sources)


class _Device(Plain):
    name: str = Field(min_length=1)
    bundle: str = Field(min_length=1)
    recordings: tuple[str, ...] = Field(min_length=1)
    run: str | None = None


class _Fleet(Plain):
    device: tuple[_Device, ...]


def of_fleet(choices: Choices, path: Path, before: Job | None) -> Job:
    """A run over the devices that a file names, each with its bundle and recordings; paths are relative to the file.

    A bundle that cannot be read, or a pattern that names no file, is a problem of the devices that name it.

    Args:
        choices, before: see `of_recordings`.
        path: of the file.

    Raises:
        InvalidInputError: the file cannot be read, or two devices have one name.
    """
    subject = f"fleet {path}"
    expected = "[[device]] tables with name, bundle and recordings"
    try:
        fleet = _Fleet.model_validate(tomllib.loads(read_text(path, subject, expected)))
    except (tomllib.TOMLDecodeError, ValidationError) as error:
        raise InvalidInputError(subject, error, expected) from None
    names = [device.name for device in fleet.device]
    if not names or len(set(names)) < len(names):
        raise InvalidInputError(subject, f"devices {', '.join(names) or 'none'}", "devices of different names")
    there = {} if before is None else {bundle.path: bundle for bundle in before.bundles}
    named = dict.fromkeys(_beside(path, device.bundle) for device in fleet.device)
    places = {name: place for place, name in enumerate(named)}
    bundles = [bundle_as_it_is(name, there) for name in named]
    sources, known = [], _known(before)
    for device in fleet.device:
        place = places[_beside(path, device.bundle)]
        _, lacking = bundles[place]
        run = None if device.run is None else (path.parent / device.run).absolute()
        recordings = _recordings_of(device, path.parent, known)
        sources += [look_at(device.name, found, place, run, known, lacking) for found in recordings]
    return Job(choices=choices, bundles=tuple(bundle for bundle, _ in bundles), sources=tuple(sources))


def _recordings_of(device: _Device, folder: Path, known: Mapping[tuple[str, Path], Source]) -> list[Path]:
    """Files of a device; of a pattern that names none, or named none when the run began, the pattern itself.

    Of files that have gone since, nothing: the run knows them.
    """
    found: dict[Path, None] = {}
    begun = any(name == device.name for name, _ in known)
    for pattern in device.recordings:
        itself = (folder / pattern).absolute()
        if (device.name, itself) in known:
            found[itself] = None
            continue
        try:
            found |= dict.fromkeys(found_recordings([pattern], folder))
        except InvalidInputError:
            found |= {} if begun else {itself: None}
    return list(found)


def _known(job: Job | None) -> dict[tuple[str, Path], Source]:
    return {} if job is None else {(source.device, source.path): source for source in job.sources}


def _beside(fleet: Path, bundle: str) -> Path:
    """Path of a bundle: of a shipped one by its name, else relative to the fleet's file."""
    shipped = bundle_path(bundle)
    return (shipped if shipped != Path(bundle) else fleet.parent / bundle).absolute()
