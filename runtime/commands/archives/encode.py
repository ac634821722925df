"""`lightpage encode`: puts a file on pages to write."""

import secrets
import shutil
import sys
import tempfile
from pathlib import Path
from typing import BinaryIO, cast

import click
import numpy as np
from numpy.typing import NDArray

from lightpage.cli.options import JSON, new_file
from lightpage.codec.code import Code, load_code
from lightpage.codec.page_codec import PageCodec
from lightpage.codec.volume import DATA_PAGES, PARITY_PAGES, Volume, encode_volume
from lightpage.device.profile import Profile, load_profile
from lightpage.errors import InvalidInputError
from lightpage.failures import os_errors
from lightpage.files import STDOUT, write_json
from lightpage.page.symbols import pilot_mask, pilot_symbols
from lightpage.progress import track
from lightpage.recording.pages import PagesWriter
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.bundle.shipped import bundle_path


def target_of(
    bundle: str | None, profile_name: str | None, code_path: Path | None
) -> tuple[Profile, Code, NDArray[np.bool_], NDArray[np.uint8]]:
    """The device of a bundle, or of a profile and a code.

    Returns:
        Nominal profile, code of its pages, where the pilots are [ny, nx], and their levels in row order.

    Raises:
        InvalidInputError: both or neither, or no code.
        BundleError, ProfileError: they cannot be read.
    """
    if (bundle is None) == (profile_name is None):
        got = "neither --bundle nor --profile" if bundle is None else "both --bundle and --profile"
        raise InvalidInputError("options", got, "one of them")
    own = load_code(code_path) if code_path is not None else None
    if profile_name is not None:
        if own is None:
            raise InvalidInputError("options", "--profile without --code", "the code of the device's pages")
        profile = load_profile(profile_name)
        mask = pilot_mask(profile)
        return profile, own, mask, pilot_symbols(profile, own.levels)[mask]
    opened = Bundle.open(bundle_path(str(bundle)))
    code = own or opened.code
    if code is None:
        raise InvalidInputError(opened.subject, "no code", "--code CODE.toml, as `lightpage code` makes it")
    return opened.profile, code, opened.pilot_mask, opened.written_pilots(code.levels)


def _opened(file: Path) -> BinaryIO:
    """The file, or what comes on stdin where it is `-`, kept in a temporary file: it is read more than once.

    Raises:
        InvalidInputError, StorageError, SurroundingsError: it cannot be read or kept.
    """
    with os_errors(f"file {file}", "a file that can be read"):
        if file != STDOUT:
            return file.open("rb")
        kept = cast(BinaryIO, tempfile.TemporaryFile())  # noqa: SIM115  # the caller closes it
        shutil.copyfileobj(sys.stdin.buffer, kept)
        kept.seek(0)
        return kept


@click.command()
@click.argument("file", type=click.Path(path_type=Path, dir_okay=False))
@click.option("--bundle", help="Bundle of the device: its path, or the name of a shipped one.")
@click.option("--profile", "profile_name", metavar="P", help="Profile in its place: a shipped name or a file.")
@click.option("--code", "code_path", type=click.Path(path_type=Path), help="Code of pages; the bundle's by default.")
@new_file("The pages to write, PAGES.h5.")
@click.option("--volume", "volume_id", type=int, help="Number that tells files on a medium apart; random if left out.")
@click.option("--data-pages", default=DATA_PAGES, show_default=True, help="Data pages of a group.")
@click.option("--parity-pages", default=PARITY_PAGES, show_default=True, help="Pages of a group that may be lost.")
@JSON
def encode(
    file: Path,
    bundle: str | None,
    profile_name: str | None,
    code_path: Path | None,
    out: Path,
    volume_id: int | None,
    data_pages: int,
    parity_pages: int,
    json_path: Path | None,
) -> None:
    """Put FILE on pages to write: user bytes in, levels with pilots out. `-` reads stdin."""
    profile, code, mask, pilots = target_of(bundle, profile_name, code_path)
    codec = PageCodec(code, mask)
    number = secrets.randbits(32) if volume_id is None else volume_id
    with _opened(file) as source:
        volume = Volume.of_file(source, number, codec.user_bytes, data_pages, parity_pages)
        told = code.model_dump() | volume.to_json()
        with PagesWriter(out, profile, code.levels, told) as writer:
            batches = encode_volume(codec, volume, source, pilots)
            for pages in track(batches, "encode", unit="batch"):
                writer.append(pages)
    figures = {
        "file_bytes": volume.file_bytes,
        "pages": volume.pages,
        "user_bytes_per_page": codec.user_bytes,
        "code": told,
    }
    write_json(json_path, figures)
    click.echo(
        f"{out}: volume {volume.id}, {volume.pages} pages of {code.levels} levels and {codec.user_bytes} bytes; "
        f"{volume.file_bytes} bytes on {volume.file_pages}, parity on {volume.pages - volume.file_pages}"
    )
