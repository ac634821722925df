"""The question of a bulk run, from what is named now and what its folder was asked before."""

import glob
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from pydantic import Field, ValidationError

from lightpage.clock import Clock
from lightpage.device.problems import mistakes
from lightpage.errors import InvalidInputError
from lightpage.files import check_utf8, matching, read_toml
from lightpage.progress import note
from lightpage.runtime.archives.run.driver import AGAIN_S
from lightpage.runtime.archives.run.job import Job, Source, bundle_as_it_is, look_at, named_bundle
from lightpage.runtime.archives.run.task import Choices, Plain
from lightpage.runtime.model.bundle.shipped import DEFAULT, bundle_path


def asked_job(
    folder: Path,
    before: Job | None,
    choices: Choices,
    recordings: tuple[str, ...],
    fleet: Path | None,
    bundle: str | None,
    retry_lost: bool,
    clock: Clock,
) -> Job:
    """Return what is asked; that of the folder, where it is the same question or none.

    Args:
        folder: folder of the run.
        before: what it was asked before; None for nothing.
        choices: how.
        recordings, fleet, bundle: what is named now; empty or None for nothing.
        retry_lost: whether recordings that were given up are tried again.
        clock: clock of the pauses before what could not be opened is tried again.

    Raises:
        InvalidInputError: neither asked now nor before, or something else before.
    """
    if recordings and fleet is not None:
        raise InvalidInputError("options", "--recordings and --fleet", "one of them")
    if fleet is not None and bundle is not None:
        raise InvalidInputError("--bundle", "with --fleet", "the bundles that the fleet's file names")
    if fleet is not None:
        asked = of_fleet(choices, fleet, before)
    elif recordings:
        default = DEFAULT if before is None else str(before.bundles[0].path)
        asked = of_recordings(choices, recordings, bundle or default, before)
    elif before is None:
        got = f"no --recordings and no --fleet, and no run in {folder}"
        raise InvalidInputError("options", got, "one of them")
    else:
        asked = before.model_copy(update={"choices": choices})
        if bundle is not None:
            asked = asked.model_copy(update={"bundles": (named_bundle(bundle),) * len(before.bundles)})
    if before is not None:
        before.check(folder, asked)
        asked = before.with_bundles_of(asked).looked_at_again(given_up=retry_lost)
    for pause_s in AGAIN_S:
        if not asked.passing():
            break
        note(f"recordings or bundles could not be opened; they are tried again in {pause_s:g} s")
        clock.sleep(pause_s)
        asked = asked.looked_at_again()
    return asked


def with_round(job: Job, bundle: str) -> Job:
    """A job with one more round, if it does not have it."""
    model = named_bundle(bundle)
    known = tuple(model if other.sha256 == model.sha256 else other for other in job.rounds)
    return job.model_copy(update={"rounds": known if model in known else (*known, model)})


def found_recordings(patterns: Sequence[str], folder: Path | None = None) -> list[Path]:
    """Files that the patterns name, each once, sorted within a pattern.

    A file that has a pattern for its name, brackets and all, is meant by it.

    Args:
        patterns: names, or patterns of `glob`; ``~`` is the home folder where nothing has that name.
        folder: folder that they are relative to; by default the working folder.

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


def of_recordings(choices: Choices, patterns: Sequence[str], bundle: str, before: Job | None) -> Job:
    """A run over recordings of one device, or of devices that share a bundle.

    Args:
        choices: how.
        patterns: patterns of the recordings' names.
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
        path: path of the file.

    Raises:
        InvalidInputError: the file cannot be read, or two devices have one name.
    """
    subject = f"fleet {path}"
    expected = "[[device]] tables with name, bundle and recordings"
    try:
        fleet = _Fleet.model_validate(read_toml(path, subject, expected))
    except ValidationError as error:
        raise InvalidInputError(subject, mistakes(_Fleet, error), expected) from None
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
