"""`lightpage record`: pages of any source into a recording, one by one, so that an interruption loses nothing."""

import sys
import time
from collections import Counter
from contextlib import closing
from pathlib import Path

import click
import numpy as np

from lightpage.cli.main import RESUME_KEY
from lightpage.cli.options import JSON
from lightpage.cli.paths import OutputFile, check_new
from lightpage.device.profile import Profile, load_profile
from lightpage.errors import FrameError, InvalidInputError, LostDataError, LostPageError, LostShotError, SourceError
from lightpage.files import write_json
from lightpage.page.symbols import random_symbols
from lightpage.progress import note, track, warn
from lightpage.recording.exposure import check_pair_light
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import LostShot
from lightpage.recording.pages import Pages
from lightpage.recording.unfinished import Identity, pages_there, partial_path
from lightpage.recording.writer import RecordingWriter
from lightpage.runtime.device.acquisition.page_store import PageStore
from lightpage.runtime.device.acquisition.source import FrameSource, Shot, open_source
from lightpage.words import counted

ATTEMPTS = 5
"""Times that a page is read before the recording stops; the source repeats lost shots by itself within each."""
_SHOT_S = 30.0
"""Wait for a page: long enough for a plug that has slipped out."""


@click.command()
@click.option("--source", "spec", required=True, help="camera:CONFIG.toml, simulator:PROFILE or recording:FILE.")
@click.option("--pages", type=click.IntRange(1), help="Number of pages; by default all that --symbols holds.")
@click.option(
    "--symbols",
    type=click.Path(path_type=Path),
    help="Pages to show, PAGES.h5, as `encode` makes them; --pages of random known symbols if left out.",
)
@click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0), help="Seed of random symbols.")
@click.option("--profile", "profile_name", metavar="P", help="Nominal device, where the source does not know it.")
@click.option("--out", required=True, type=OutputFile(), help="The recording, R.h5.")
@click.option(
    "--shot-seconds", type=click.FloatRange(0, min_open=True), help="Longest wait for one page, 30 s or the source's."
)
@click.option("--dark/--no-dark", default=True, show_default=True, help="Take dark frames first; mend hot pixels.")
@click.option("--force", is_flag=True, help="Overwrite a recording that exists.")
@JSON
def record(
    spec: str,
    pages: int | None,
    symbols: Path | None,
    seed: int,
    profile_name: str | None,
    out: Path,
    shot_seconds: float | None,
    dark: bool,
    force: bool,
    json_path: Path | None,
) -> None:
    """Record pages of a camera, or of any other source.

    Dark and reference frames come first. The device blocks their beams; where it cannot, you are asked to. Interrupted,
    the same command goes on where it stopped. Lost shots are noted in the recording. Exit status 3: shots stayed lost.
    """
    check_new(out, force)
    with closing(open_source(spec)) as source:
        source.operator = ask_operator
        profile = load_profile(profile_name) if profile_name is not None else source.profile
        if profile is None:
            raise InvalidInputError("options", f"no --profile, which {source.name} does not tell either", "--profile P")
        source.check_against(profile)
        if symbols is not None:
            source.show_pages(PageStore(profile, Pages.open(symbols)))
        elif pages is not None and source.page_count() == 0:
            store, levels = PageStore(profile), source.levels
            store.append(random_symbols(profile, levels, pages, np.random.default_rng(seed)), levels)
            source.show_pages(store)
        count = _count(source, pages, symbols)
        identity = _identity(source, profile)
        there = pages_there(out, identity, overwrite=force)
        _check_room(count, there)
        _tell_where(out, there)
        source.on_lost = _tell_loss
        longest_s = max(_SHOT_S, source.shot_s) if shot_seconds is None else shot_seconds
        try:
            with source:
                _record(source, identity, count, out, longest_s, dark, force, json_path)
        except LostShotError as error:  # of dark or reference frames
            raise LostDataError(error.subject, error.got, f"{error.expected} ({error.reason.value})") from None


def _count(source: FrameSource, asked: int | None, symbols: Path | None) -> int:
    """Return how many pages are to be recorded.

    Raises:
        InvalidInputError: nobody says how many, or there are fewer.
    """
    there = source.page_count()
    if there == 0:
        raise InvalidInputError("--symbols", f"none, and {source.name} has no pages to show", "PAGES.h5, or --pages")
    if asked is None and there is None:
        raise InvalidInputError("options", "neither --pages nor pages to show", "one of them")
    if asked is not None and there is not None and asked > there:
        named = f"--symbols {symbols}" if symbols is not None else source.name
        raise InvalidInputError("--pages", asked, f"at most the {counted(there, 'page')} of {named}")
    return asked or there or 0


def _identity(source: FrameSource, profile: Profile) -> Identity:
    """Return what is known of the pages that a source shows before they are photographed."""
    if (pages := source.pages) is None:
        return Identity(profile, source.levels, source.bit_depth)
    symbols = pages.__getitem__ if len(pages) else None
    return Identity(profile, source.levels, source.bit_depth, pages.code, symbols)


def _check_room(count: int, there: int) -> None:
    if there > count:
        raise InvalidInputError("--pages", count, f"at least the {counted(there, 'page')} already there")


def _tell_where(out: Path, pages: int) -> None:
    """Have whoever interrupts the command be told how it goes on."""
    there = f"{counted(pages, 'page')} {'is' if pages == 1 else 'are'} in {partial_path(out)}; " if pages else ""
    go_on = "the same command goes on from there" if pages else "no page is recorded yet"
    click.get_current_context().meta[RESUME_KEY] = there + go_on


def _tell_loss(page: int, error: LostShotError) -> None:
    what = f"page {page}" if page >= 0 else "frames without a page"
    warn(f"{what}: shot lost ({error.reason.value}): {error.subject}: {error.got}")


def _record(
    source: FrameSource,
    identity: Identity,
    count: int,
    out: Path,
    shot_seconds: float,
    dark: bool,
    force: bool,
    json_path: Path | None,
) -> None:
    """Record pages of a source that is armed; see `record`."""
    if dark:
        note("dark frames")
    dark_frames = source.dark_frames() if dark else None
    note("reference frames")
    references = source.references()
    if references is None:
        raise InvalidInputError(f"source {source.name}", "no reference frames", "a source that can block its signal")
    losses: list[LostShot] = []
    repeated = 0
    begun = time.perf_counter()
    with RecordingWriter(
        out,
        identity.profile,
        identity.levels,
        identity.bit_depth,
        references,
        resume=True,
        code=identity.code,
        keep_references=True,
        symbols=identity.symbols,
        overwrite=force,
    ) as writer:
        _check_room(count, writer.pages)
        if dark_frames is not None:
            first, second = dark_frames
            writer.set_dark_frames(FramePair(first.mean, second.mean), (first.hot, second.hot))

        def keep(page: int, error: LostShotError) -> None:
            _tell_loss(page, error)
            losses.append(LostShot(page, error.reason.value, str(error), time.time()))
            writer.add_loss(losses[-1])

        source.on_lost = keep
        begun_at = writer.pages
        for index in track(range(begun_at, count), "record", total=count, done=begun_at):
            shot, attempts = _good_shot(source, index, shot_seconds)
            repeated += attempts - 1
            writer.append(shot.symbols, shot.pair, infos=shot.infos)
            _tell_where(out, writer.pages)
    by_reason = Counter(loss.reason for loss in losses)
    figures = {
        "pages": count,
        "pages_recorded_now": count - begun_at,
        "pages_repeated": repeated,
        "shots_lost": len(losses),
        "losses": dict(by_reason),
        "shots": dict(source.shots_by_outcome()),
        "saturated_shares": dict(source.saturated_shares()),
        "hot_pixels": None if dark_frames is None else [len(one.hot) for one in dark_frames],
        "black_levels": None if dark_frames is None else [one.black_level for one in dark_frames],
        "seconds": time.perf_counter() - begun,
    }
    write_json(json_path, figures)
    told = ", ".join(f"{times} {reason}" for reason, times in sorted(by_reason.items()))
    click.echo(
        f"{out}: {counted(count, 'page')} of {source.levels} levels; "
        f"{counted(len(losses), 'shot')} lost{f' ({told})' if told else ''}"
    )


def _good_shot(source: FrameSource, index: int, seconds: float) -> tuple[Shot, int]:
    """A page with light on it, and the times that it took.

    Raises:
        LostDataError: none of `ATTEMPTS` was good.
    """
    page = f"page {index} of {source.name}"
    attempt = 0
    while True:
        attempt += 1
        try:
            shot = source.shot(seconds, index)
            check_pair_light(f"{page}: ", shot.pair, source.bit_depth)
            return shot, attempt
        except (LostPageError, FrameError) as error:
            if attempt < ATTEMPTS:
                continue
            subject = error.subject if error.subject.startswith(page) else f"{page}: {error.subject}"
            reason = f"{error.reason.value}; " if isinstance(error, LostPageError) else ""
            tried = f"{reason}lost {ATTEMPTS} times in a row; the same command goes on from here"
            raise LostDataError(subject, error.got, f"{error.expected} ({tried})") from None


def ask_operator(text: str) -> None:
    """Ask whoever sits at the terminal, and wait for Enter."""
    if not sys.stdin.isatty():
        raise SourceError("operator", "no terminal to ask at", f"somebody who does this: {text}")
    click.prompt(f"{text}, then press Enter", default="", show_default=False, prompt_suffix=" ")
