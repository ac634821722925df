"""`lightpage import`: make a recording of frames and symbols that other programs have written."""

from __future__ import annotations

import hashlib
import json
import shlex
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import click
import numpy as np
from numpy.typing import NDArray

from lightpage.cli.main import RESUME_KEY
from lightpage.cli.options import JSON, named_profile
from lightpage.cli.paths import OutputFile, check_new
from lightpage.device.profile import Profile
from lightpage.errors import FrameError, InvalidInputError, PageError
from lightpage.failures import os_errors
from lightpage.files import read_text, write_json
from lightpage.foreign.array import ForeignArray
from lightpage.foreign.frames import Arrangement, Flip, Frames, Turn, Upright, both_cameras, one_camera
from lightpage.foreign.frames import Pages as ForeignPages
from lightpage.foreign.import_job import Material, blemishes_of, describe, exposure_of, references_of, tell, write
from lightpage.foreign.opening import open_array
from lightpage.page.levels import MAX_LEVELS, MIN_LEVELS
from lightpage.progress import warn
from lightpage.recording.layout import MAX_BIT_DEPTH, MIN_BIT_DEPTH
from lightpage.recording.pages import Pages
from lightpage.recording.unfinished import claim, drop_claim
from lightpage.recording.writer import RecordingWriter

FLIPS: dict[str, Flip] = {each or "none": each for each in get_args(Flip)}
TURNS: dict[str, Turn] = {str(each): each for each in get_args(Turn)}
Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]
_CAMERAS = ("in-phase", "quadrature")


def _source(name: str, told: str) -> Decorator:
    return click.option(f"--{name}", metavar="FILE", help=told)


def _upright(camera: str) -> Decorator:
    """Return a decorator that adds the options by which the frames of a camera are set upright."""
    flip = click.option(
        f"--flip-{camera}", type=click.Choice(FLIPS), default="none", show_default=True, help="x: left for right."
    )
    turn = click.option(
        f"--turn-{camera}",
        type=click.Choice(TURNS),
        default="0",
        show_default=True,
        help="Degrees clockwise, after it.",
    )
    return lambda command: flip(turn(command))


@click.command(name="import")
@_source("in-phase", "Frames of the in-phase camera.")
@_source("quadrature", "Frames of the quadrature camera.")
@_source("frames", "Frames of both cameras in one file.")
@click.option(
    "--arrangement",
    type=click.Choice([each.value for each in Arrangement]),
    help="Arrangement of both cameras in --frames.",
)
@_source("reference-in-phase", "Frames of the reference beam alone; of several the mean is taken.")
@_source("reference-quadrature", "Frames of the reference beam alone, quadrature camera.")
@_source("references", "Reference frames of both cameras in one file, arranged as --frames.")
@_source(
    "symbols", "Symbols that were written: PAGES.h5 of `encode`, or whole numbers [pages, ny, nx]. Unknown if left out."
)
@_source("pilots", "Mask of the known symbols [ny, nx], 0 elsewhere; the profile's places if left out.")
@_source("code", "Description of the pages' code, code.json of `unpack`.  [default: that of --symbols PAGES.h5]")
@click.option("--profile", "profile_name", metavar="P", help="Nominal device.  [default: that of --symbols PAGES.h5]")
@click.option(
    "--levels", type=click.IntRange(MIN_LEVELS, MAX_LEVELS), help="Level count M of the symbols.  [default: 256]"
)
@click.option(
    "--bit-depth",
    type=click.IntRange(MIN_BIT_DEPTH, MAX_BIT_DEPTH),
    help="Bits of a count; found in the frames if left out.",
)
@click.option("--black-level", type=click.IntRange(min=0), default=0, help="Counts of a camera in the dark.")
@_upright("in-phase")
@_upright("quadrature")
@click.option("--keep-unlit", is_flag=True, help="Take black and saturated frames too, and list them.")
@click.option("--out", required=True, type=OutputFile(), help="The recording, R.h5.")
@click.option("--force", is_flag=True, help="Overwrite a recording that exists, or pages begun with other settings.")
@JSON
def import_frames(out: Path, force: bool, keep_unlit: bool, json_path: Path | None, **given: Any) -> None:
    """Make a recording of frames and symbols that other programs have written.

    FILE is a TIFF stack, .npy, .npz, .mat or HDF5, a folder of pictures, or a pattern in quotes that matches some.
    FILE::NAME names one of several arrays. Pages lie along the first axis or, as in MATLAB, along the last.

    Interrupted, the same command goes on where it stopped.
    """
    click.get_current_context().meta[RESUME_KEY] = "run the same command again; it goes on where it was"
    if out.is_dir():
        raise InvalidInputError(f"--out {out}", "a folder", "a new file")
    check_new(out, force)
    with ExitStack() as opened:
        sources = _Sources(given, opened)
        material = sources.material()
        sources.check_kept(out)
        material.check()
        exposure = exposure_of(material, given["bit_depth"])
        tell(exposure, material)
        references = references_of(material, exposure)
        claim(out, f"{sources.described()}\n# profile\n{material.profile.to_toml()}", force=force)
        writer = RecordingWriter(
            out,
            material.profile,
            material.levels,
            exposure.bit_depth,
            references,
            material.pilots,
            resume=True,
            code=material.code,
            symbols=None if material.symbols is None else material.page_symbols,
            overwrite=force,
            black_level=material.black_level,
        )
        try:
            with writer:
                unlit = write(material, exposure, writer, keep_unlit=keep_unlit)
        except (FrameError, PageError):  # the files or the options are to be mended, which makes it another recording
            drop_claim(out, pages=True)
            raise
    drop_claim(out)
    if unlit:
        warn(describe(unlit))
    blemishes = blemishes_of(out)
    figures = {
        "pages": material.pages,
        "frame_shape": list(material.profile.frame_shape),
        "levels": material.levels,
        "symbols": material.symbols is not None,
        "black_level": material.black_level,
        **asdict(exposure),
        "unlit": [asdict(each) for each in unlit],
        "blemishes": blemishes,
    }
    write_json(json_path, figures)
    click.echo(
        f"{out}: {material.pages} pages, {exposure.bit_depth} bits, symbols "
        f"{'of ' + str(material.levels) + ' levels' if material.symbols is not None else 'unknown'}; "
        f"next: {shlex.join(['lightpage', 'inspect', str(out)])}"
    )


@dataclass(frozen=True)
class _Sources:
    """The files that the options name.

    Attributes:
        given: the options.
        opened: closes the files.
        files: that were opened, by option.
    """

    given: dict[str, Any]
    opened: ExitStack
    files: dict[str, Sequence[Path]] = field(default_factory=dict)

    def material(self) -> Material:
        """Open all files; sizes are checked, and nothing is read of frames yet."""
        given, pages = self.given, self._pages()
        profile = named_profile(given["profile_name"])
        if profile is None and pages is None:
            raise InvalidInputError("options", "no --profile", "one, or --symbols with pages that carry it")
        if pages is not None:
            profile = pages.device(profile)
            if given["levels"] not in (None, pages.levels):
                raise InvalidInputError("--levels", given["levels"], f"{pages.levels}, as {pages.path} has, or nothing")
        assert profile is not None  # or it was refused above
        levels = given["levels"] if pages is None else pages.levels
        symbols = None
        if given["symbols"] is not None:
            symbols = ForeignPages(self._open("symbols"), profile.page_shape, _what("symbols", profile))
        return Material(
            profile,
            self._cameras("frames", profile),
            self._cameras("references", profile),
            symbols,
            levels or MAX_LEVELS,
            self._pilots(profile),
            self._code(None if pages is None else pages.code),
            given["black_level"],
            levels is not None,
        )

    def check_kept(self, out: Path) -> None:
        """Check that the recording does not take the place of a file that it is made of.

        Raises:
            InvalidInputError: it does.
        """
        for option, files in self.files.items():
            if out.exists() and any(path.samefile(out) for path in files):
                named = f"the same file as --{option.replace('_', '-')}"
                raise InvalidInputError(f"--out {out}", named, "another name")

    def described(self) -> str:
        """Return what the pages are made of: the options, and a digest of name, size and time of the files of each."""
        lines = []
        for name, value in sorted(self.given.items()):
            stamp = f"  # {_stamp(self.files[name])}" if name in self.files else ""
            lines.append(f"{name} = {value!r}{stamp}")
        return "\n".join(lines)

    def _pages(self) -> Pages | None:
        """Return the file of pages to write that the symbols are in; None where it is another one."""
        path = Path(self.given["symbols"] or "")
        if path.suffix.lower() not in (".h5", ".hdf5") or not path.is_file():
            return None
        if not Pages.are_in(path):
            return None
        pages = self.opened.enter_context(Pages.open(path))
        pages.check()
        return pages

    def _open(self, option: str) -> ForeignArray:
        array = self.opened.enter_context(closing(open_array(self.given[option])))
        self.files[option] = array.files
        return array

    def _code(self, of_pages: str | None) -> str | None:
        """Return what the pages hold, JSON text: that of the pages to write, or of --code."""
        if (named := self.given["code"]) is None:
            return of_pages
        subject, expected = f"--code {named}", "a JSON object, as `unpack` writes it"
        if of_pages is not None:
            raise InvalidInputError(subject, "a code beside that of --symbols", "one of them")
        text = read_text(named, subject, expected)
        self.files["code"] = (Path(named),)
        try:
            told = json.loads(text)
        except ValueError as error:
            raise InvalidInputError(subject, error, expected) from None
        if not isinstance(told, dict):
            raise InvalidInputError(subject, "JSON that is no object", expected)
        return text

    def _uprights(self) -> tuple[Upright, Upright]:
        first, second = (
            Upright(FLIPS[self.given[f"flip_{camera}"]], TURNS[self.given[f"turn_{camera}"]])
            for camera in ("in_phase", "quadrature")
        )
        return first, second

    def _cameras(self, kind: Literal["frames", "references"], profile: Profile) -> tuple[Frames, Frames]:
        prefix = "" if kind == "frames" else "reference-"
        names = [f"{prefix}{camera}" for camera in _CAMERAS]
        options = [name.replace("-", "_") for name in names]
        both = self.given[kind]
        _check_named([self.given[option] for option in options], both, names, kind)
        what, uprights = _what("frames", profile), self._uprights()
        if both is not None:
            way = self.given["arrangement"]
            arrangement = None if way is None else Arrangement(way)
            return both_cameras(self._open(kind), profile.frame_shape, uprights, arrangement, what)
        first, second = (
            one_camera(self._open(option), profile.frame_shape, upright, what)
            for option, upright in zip(options, uprights, strict=True)
        )
        return first, second

    def _pilots(self, profile: Profile) -> NDArray[np.bool_] | None:
        if self.given["pilots"] is None:
            return None
        found = ForeignPages(self._open("pilots"), profile.page_shape, _what("pilots", profile))
        if found.count != 1:
            raise InvalidInputError(found.subject, f"{found.count} pages of pilots", "one")
        if (different := len(np.unique(found.page(0)))) > 2:
            expected = "two: 0, and another one where a symbol is known"
            raise InvalidInputError(found.subject, f"{different} different values", expected)
        places = np.asarray(found.page(0) != 0)
        if not 0 < (known := np.count_nonzero(places)) < places.size / 2:
            expected = "some of them, less than half"
            raise InvalidInputError(found.subject, f"{known} pilots of {places.size} symbols", expected)
        return places


def _check_named(single: Sequence[str | None], both: str | None, names: Sequence[str], kind: str) -> None:
    """Check that the frames of both cameras are named, once."""
    named = [f"--{name}" for name, value in zip((*names, kind), (*single, both), strict=True) if value is not None]
    if named not in ([f"--{name}" for name in names], [f"--{kind}"]):
        expected = f"--{names[0]} and --{names[1]}, or --{kind}"
        if kind == "references":
            expected += ": frames of the reference beam alone"
        raise InvalidInputError("options", " and ".join(named) or f"no {kind}", expected)


def _stamp(files: Sequence[Path]) -> str:
    """Return how many files there are, and a digest of their names, sizes and times of change."""
    digest = hashlib.sha256()
    for path in files:
        with os_errors(f"file {path}", "a file that can be read"):
            found = path.stat()
        digest.update(f"{path}\0{found.st_size}\0{found.st_mtime_ns}\0".encode(errors="surrogateescape"))
    return f"{len(files)} files, {digest.hexdigest()}"


def _what(kind: str, profile: Profile) -> str:
    return f"{kind} (profile {profile.name})"
