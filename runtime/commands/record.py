"""`lightpage record`: pages of any source into a recording, one by one, so that an interruption loses nothing."""

from __future__ import annotations

import sys
import time
from collections import Counter
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray

from lightpage.cli.paths import OutputFile
from lightpage.device.profile import Profile, load_profile
from lightpage.errors import FrameError, InvalidInputError, LostDataError
from lightpage.files import write_json
from lightpage.progress import track
from lightpage.recording.black_level import DarkFrame
from lightpage.recording.exposure import check_pair_light
from lightpage.recording.layout import FramePair, LostShot
from lightpage.recording.pages import Pages
from lightpage.recording.writer import RecordingWriter
from runtime.acquisition.page_store import PageStore
from runtime.acquisition.source import FrameSource, Shot
from runtime.acquisition.sources import open_source
from runtime.errors import LostPageError, LostShotError, SourceError

ATTEMPTS = 5
"""Times that a page is read before the recording stops; the source repeats lost shots by itself within each."""
_SHOT_S = 30.0
"""Wait for a page: long enough for a plug that has slipped out."""


@click.command()
@click.option("--source", "spec", required=True, help="camera:CONFIG.toml, simulator:PROFILE or recording:FILE.")
@click.option("--pages", type=click.IntRange(1), help="How many; by default all that --symbols holds.")
@click.option("--symbols", type=click.Path(path_type=Path), help="Pages to show, PAGES.h5, as `encode` makes them.")
@click.option("--profile", "profile_name", metavar="P", help="Nominal device, where the source does not know it.")
@click.option("--out", required=True, type=OutputFile(), help="The recording, R.h5.")
@click.option(
    "--shot-seconds", type=click.FloatRange(0, min_open=True), help="Longest wait for one page, 30 s or the source's."
)
@click.option("--dark/--no-dark", default=True, show_default=True, help="Take dark frames first; mend hot pixels.")
@click.option("--force", is_flag=True, help="Overwrite a recording that exists.")
@click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file.")
def record(
    spec: str,
    pages: int | None,
    symbols: Path | None,
    profile_name: str | None,
    out: Path,
    shot_seconds: float | None,
    dark: bool,
    force: bool,
    json_path: Path | None,
) -> None:
    """Record pages of a camera, or of any other source.

    Dark and reference frames come first. The device blocks their beams; where it cannot, you are asked to. Interrupted,
    the same command goes on where it stopped. Lost shots are noted in the recording.
    """
    if out.exists() and not force:
        raise InvalidInputError(f"--out {out}", "a file that exists", "a new name, or --force")
    source = open_source(spec)
    source.operator = _ask
    try:
        profile = load_profile(profile_name) if profile_name is not None else source.profile
        if profile is None:
            raise InvalidInputError("options", f"no --profile, which {source.name} does not tell either", "--profile P")
        source.check_against(profile)
        if symbols is not None:
            source.show_pages(PageStore(profile, Pages.open(symbols)))
        count = pages or len(source.pages or ())
        if not count:
            raise InvalidInputError("options", "neither --pages nor pages to show", "one of them")
        with source:
            longest_s = max(_SHOT_S, source.shot_s) if shot_seconds is None else shot_seconds
            _record(source, profile, count, out, longest_s, dark, json_path)
    finally:
        source.close()


def _record(
    source: FrameSource,
    profile: Profile,
    count: int,
    out: Path,
    shot_seconds: float,
    dark: bool,
    json_path: Path | None,
) -> None:
    """Record pages of a source that is armed; see `record`."""
    dark_frames = source.dark_frames() if dark else None
    references = source.references()
    if references is None:
        raise InvalidInputError(f"source {source.name}", "no reference frames", "a source that can block its signal")
    code = None if source.pages is None else source.pages.code
    losses: list[LostShot] = []
    repeated = 0
    begun = time.perf_counter()
    with RecordingWriter.resume(
        out, profile, source.levels, source.bit_depth, references, code=code, keep_references=True
    ) as writer:
        if writer.pages > count:
            raise InvalidInputError("--pages", count, f"at least the {writer.pages} pages that are there already")
        if dark_frames is not None:
            writer.set_dark_frames(*_darkness(dark_frames))

        def note(page: int, error: LostShotError) -> None:
            losses.append(LostShot(page, error.reason.value, str(error), time.time()))
            writer.add_loss(losses[-1])

        source.on_lost = note
        first = writer.pages
        for index in track(range(first, count), "record", total=count, done=first):
            shot, attempts = _good_shot(source, index, shot_seconds)
            repeated += attempts - 1
            writer.append(shot.symbols, shot.pair, infos=shot.infos)
    by_reason = Counter(loss.reason for loss in losses)
    figures = {
        "pages": count,
        "pages_recorded_now": count - first,
        "pages_repeated": repeated,
        "shots_lost": len(losses),
        "losses": dict(by_reason),
        "shots": dict(source.shots_by_outcome()),
        "saturated_shares": dict(source.saturated_shares()),
        "hot_pixels": None if dark_frames is None else [len(one.hot) for one in dark_frames],
        "black_levels": None if dark_frames is None else [one.black_level for one in dark_frames],
        "seconds": time.perf_counter() - begun,
    }
    if json_path is not None:
        write_json(json_path, figures)
    told = ", ".join(f"{times} {reason}" for reason, times in sorted(by_reason.items()))
    click.echo(
        f"{out}: {count} pages of {source.levels} levels; {len(losses)} shots lost{f' ({told})' if told else ''}"
    )


def _good_shot(source: FrameSource, index: int, seconds: float) -> tuple[Shot, int]:
    """A page with light on it, and the times that it took.

    Raises:
        LostDataError: none of `ATTEMPTS` was good.
    """
    for attempt in range(1, ATTEMPTS):
        try:
            return _shot(source, index, seconds), attempt
        except (LostPageError, FrameError):
            continue
    try:
        return _shot(source, index, seconds), ATTEMPTS
    except (LostPageError, FrameError) as error:
        expected = f"one good shot of {ATTEMPTS}; run the same command again to go on from here"
        raise LostDataError(f"page {index} of {source.name}", error, expected) from None


def _shot(source: FrameSource, index: int, seconds: float) -> Shot:
    shot = source.shot(seconds, index)
    check_pair_light(f"page {index} of {source.name}: ", shot.pair, source.bit_depth)
    return shot


def _darkness(dark: tuple[DarkFrame, DarkFrame]) -> tuple[FramePair, tuple[NDArray[np.intp], NDArray[np.intp]]]:
    first, second = dark
    return FramePair(first.mean, second.mean), (first.hot, second.hot)


def _ask(text: str) -> None:
    """Ask whoever sits at the terminal, and wait for Enter."""
    if not sys.stdin.isatty():
        raise SourceError("operator", "no terminal to ask at", f"somebody who does this: {text}")
    click.prompt(f"{text}, then press Enter", default="", show_default=False, prompt_suffix=" ")
