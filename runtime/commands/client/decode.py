"""`lightpage decode`: decodes pages with a running service."""

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path
from statistics import fmean
from typing import Any

import click
import numpy as np

from lightpage.cli.main import RESUME_KEY
from lightpage.cli.options import JSON, new_file
from lightpage.device.profile import parse_profile
from lightpage.errors import InvalidInputError, LightpageError, LostPageError, RecordingError, SourceError, StorageError
from lightpage.files import write_json
from lightpage.metrics.measures import PageMeasures, measure
from lightpage.page.levels import Levels
from lightpage.page.symbols import pilot_symbols
from lightpage.progress import track, warn
from lightpage.recording.decoded_file import DecodedWriter
from lightpage.recording.layout import narrow
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.refused import WORTH_NOTHING, RefusedPage, refusal, refused_json
from lightpage.runtime.client.answers import RemotePage
from lightpage.runtime.client.client import LightpageClient
from lightpage.runtime.client.outgoing import KnownPilots
from lightpage.runtime.client.wire.channel import TlsFiles
from lightpage.runtime.commands.client.connection import TARGET, with_tls
from lightpage.runtime.model.decoding.image_drift import LEAST_COHERENCE

_FIGURES = (
    *("page", "model_version", "piston_rad", "pilot_coherence", "pilot_trust"),
    *("claimed_bits", "confirmed_bits", "recalibration_due"),
)
"""Of a page, as its report names them too."""


@click.command()
@TARGET
@with_tls
@click.option("--recording", type=click.Path(), help="Send the pages of this recording.")
@click.option("--source", is_flag=True, help="Have the service read pages from its own source.")
@click.option("--pages", type=click.IntRange(1), help="Page count; all of a recording, or one of the source.")
@click.option("--levels", type=click.IntRange(2, 256), help="Level count; that of the recording or source by default.")
@new_file("Write symbols and confidences to this HDF5 file.", required=False)
@JSON
def decode(
    target: str,
    tls: TlsFiles | None,
    recording: str | None,
    source: bool,
    pages: int | None,
    levels: int | None,
    out: Path | None,
    json_path: Path | None,
) -> None:
    """Decode a recording, or pages of the service's source.

    Pages that are refused, or whose pilots do not confirm the result, are left out of the results, named, and make the
    exit status 2.
    """
    if (recording is None) == (not source):
        came = "both --recording and --source" if source else "neither --recording nor --source"
        raise InvalidInputError("options", came, "one of them")
    results: list[dict[str, Any]] = []
    refused: list[RefusedPage] = []
    with ExitStack() as stack:
        client = stack.enter_context(LightpageClient(target, tls=tls))
        if recording is not None:
            file = stack.enter_context(Recording.open(recording))
            if pages is not None and pages > file.pages:
                raise RecordingError(f"recording {recording}", f"{file.pages} pages", f"at least {pages} (--pages)")
            count, levels = pages or file.pages, levels or file.levels
            subject, decoded = f"recording {recording}", _sent(client, file, count, levels)
        else:
            count, levels = pages or 1, levels or client.describe().source_levels
            if not levels:
                raise InvalidInputError(f"service at {target}", "no source", "a service started with --source")
            subject, decoded = f"source of {target}", _read(client, count, levels)
        writer = stack.enter_context(DecodedWriter(out, levels)) if out is not None else None
        broke = None
        try:
            for page in track(decoded, "decode", total=count):
                if isinstance(page, RefusedPage):
                    refused.append(page)
                    continue
                if writer is not None:
                    writer.append(page.symbols, page.confidence, page.model_version, page.page)
                results.append(page_report(page))
        except (LightpageError, KeyboardInterrupt) as error:
            if not results or recording is not None:
                raise
            broke = error  # the source does not show the same pages again: what came is kept
            click.get_current_context().meta[RESUME_KEY] = "what came before is kept"
        told = {"target": target, "levels": levels, "pages": results, "pages_asked_for": count}
        write_json(json_path, told | refused_json(refused))
        if refused and not results:
            raise refusal(subject, refused, count)
    click.echo(table(results))
    if broke is not None:
        warn(f"{subject}: {len(results) + len(refused)} of {count} pages came")
        raise broke
    rates = [rate for result in results if (rate := result["air_bits_per_symbol"]) is not None]
    if rates and fmean(rates) <= 0:
        warn(WORTH_NOTHING)
    if due := [result for result in results if result["recalibration_due"]]:
        warn(drifted(due))
    if doubtful := [result for result in results if result["pilot_coherence"] < LEAST_COHERENCE]:
        warn(unknown_pistons(doubtful))
    if refused:
        raise refusal(subject, refused, count)


def page_report(page: RemotePage) -> dict[str, Any]:
    """The figures of one page; AIR and error rate where its symbols are known."""
    figures = _measured(page)
    return {
        **{name: getattr(page, name) for name in _FIGURES},
        "mean_confidence": float(page.confidence.mean()),
        "image": page.image and asdict(page.image),
        "air_bits_per_symbol": figures and figures.air_bits_per_symbol,
        "symbol_error_rate": figures and figures.symbol_error_rate,
        **asdict(page.timings),
    }


def drifted(due: list[dict[str, Any]]) -> str:
    """Return what to think of pages that confirm less than they would on the device as it was calibrated."""
    claimed, confirmed = (fmean(result[name] for result in due) for name in ("claimed_bits", "confirmed_bits"))
    pages = f"{len(due)} {'page' if len(due) == 1 else 'pages'}"
    return (
        f"the pilots of {pages} confirm {confirmed:.2f} of the {claimed:.2f} bits a symbol that are claimed: "
        "the device has changed since it was calibrated (lightpage recalibrate)"
    )


def unknown_pistons(doubtful: list[dict[str, Any]]) -> str:
    """Return what to think of pages whose pilots disagree."""
    pages = ", ".join(f"{result['page']} ({result['pilot_coherence']:.2f})" for result in doubtful)
    return (
        f"pilots agree to less than {LEAST_COHERENCE:g} on page {pages}: the piston is unknown, "
        "and all symbols of such a page may be turned by the same amount"
    )


def table(results: list[dict[str, Any]]) -> str:
    """Return a table with a line for each page."""

    def figure(value: float | None, form: str) -> str:
        return "-" if value is None else format(value, form)

    lines = [f"{'page':>5} {'model':<20} {'confidence':>10} {'AIR':>7} {'errors':>8} {'total ms':>9}"]
    lines += [
        f"{r['page']:>5} {r['model_version']:<20} {r['mean_confidence']:>10.4f} "
        f"{figure(r['air_bits_per_symbol'], '7.3f'):>7} {figure(r['symbol_error_rate'], '8.4f'):>8} "
        f"{1e3 * r['total_s']:>9.1f}"
        for r in results
    ]
    return "\n".join(lines)


def _measured(page: RemotePage) -> PageMeasures | None:
    """Figures over the data symbols of a page whose symbols are known in the level count that was asked for."""
    if page.written is None or page.phase is None or page.concentration is None or page.pilot_mask is None:
        return None
    if page.pilot_mask.all():
        return None
    data = ~page.pilot_mask
    return measure(
        page.phase[data], page.concentration[data], page.written[data], Levels(page.levels, page.level_phases)
    )


def _read(client: LightpageClient, count: int, levels: int) -> Iterator[RemotePage | RefusedPage]:
    known = client.describe().source_levels == levels
    for _ in range(count):
        try:
            page = client.pages.read(levels=levels, want_phase=known, want_concentration=known, want_written=known)
        except (InvalidInputError, LostPageError, SourceError, StorageError) as error:
            yield RefusedPage.of(None, error)
        else:
            yield page


def _sent(client: LightpageClient, file: Recording, count: int, levels: int) -> Iterator[RemotePage | RefusedPage]:
    description = client.describe()
    own = file.pilots()
    mask = description.pilot_mask if own is None else own
    profile = parse_profile(description.profile_toml, "profile of the service")
    file.header.check_against(profile)
    pattern = pilot_symbols(profile, file.levels)
    fixed = description.pilot_phases is not None and np.array_equal(mask, description.pilot_mask)
    for index in range(count):
        try:
            symbols = file.symbols(index)
            known = symbols is not None and file.levels == levels
            values = pattern if symbols is None else symbols
            page = client.frames.decode(
                narrow(file.frames(index), file.bit_depth),
                levels,
                bit_depth=file.bit_depth,
                # Fixed phases are the service's to know: no level count need hold them.
                pilots=None if symbols is None and fixed else KnownPilots(mask, values, file.levels),
                want_phase=known,
                want_concentration=known,
            )
        except (InvalidInputError, LostPageError, StorageError) as error:
            yield RefusedPage.of(index, error)
        else:
            yield replace(page, page=index, written=symbols if known else None, pilot_mask=mask)
