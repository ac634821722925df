"""Footprint of a bundle: its size, file by file, and the time and memory that loading and decoding take.

    python -m analysis.speed.footprint --profile paper

Untrained, on frames of the simulated device: weight, time and memory do not depend on what a decoder has learnt.
Loading and decoding have a process of their own each, which holds no torch.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import zipfile
from dataclasses import asdict, dataclass
from pathlib import Path

import click
import numpy as np

from analysis.speed.footprint_process import Taken
from analysis.speed.untrained import Seen, recorded, simulated, untrained_bundle
from analysis.speed.untrained_graphs import OWN
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.device.profile import Profile, load_profile
from lightpage.device.state import Device
from lightpage.errors import InvalidInputError
from lightpage.metrics.provenance import write_figures
from lightpage.runtime.model.execution.cpus import available_cpus

_PROCESS = "analysis.speed.footprint_process"
_PATIENCE_S = 900
"""Limit for one process: a full-size page of two passes takes a few seconds."""


@dataclass(frozen=True)
class File:
    """File of a bundle.

    Attributes:
        name: name of the file.
        unpacked_bytes: size of the file.
        stored_bytes: size in the zip.
    """

    name: str
    unpacked_bytes: int
    stored_bytes: int


@dataclass(frozen=True)
class Footprint:
    """Footprint of a bundle: its size, and what loading and decoding take.

    Attributes:
        decoder: name.
        zip_bytes: size of the bundle as one file.
        files: files in it, the largest first.
        loading: cost of a process that loads it.
        decoding: cost of a process that also decodes pages.
    """

    decoder: str
    zip_bytes: int
    files: tuple[File, ...]
    loading: Taken
    decoding: Taken

    @property
    def unpacked_bytes(self) -> int:
        """Bytes of all files, unpacked."""
        return sum(file.unpacked_bytes for file in self.files)


def files_of(bundle: Path) -> tuple[File, ...]:
    """The files of a zip, the largest first."""
    with zipfile.ZipFile(bundle) as archive:
        found = [File(entry.filename, entry.file_size, entry.compress_size) for entry in archive.infolist()]
    return tuple(sorted(found, key=lambda file: -file.unpacked_bytes))


def measured(bundle: Path, pages: int, threads: int) -> Taken:
    """Load a bundle and decode so many pages in a new process, and return what that took.

    Raises:
        InvalidInputError: it failed, or took longer than it may.
    """
    asked = [sys.executable, "-m", _PROCESS, str(bundle), str(pages), str(threads)]
    subject = f"process with {bundle.name}, {pages} pages"
    try:
        done = subprocess.run(asked, capture_output=True, text=True, timeout=_PATIENCE_S, check=False)
    except subprocess.TimeoutExpired:
        raise InvalidInputError(subject, f"no end within {_PATIENCE_S} s", "one") from None
    if done.returncode:
        raise InvalidInputError(subject, done.stderr.strip().splitlines()[-1:], "an end without an error")
    told = json.loads(done.stdout.splitlines()[-1])
    return Taken(told["load_s"], tuple(told["pages_s"]), told["peak_bytes"])


def footprint(name: str, profile: Profile, seen: Seen, pages: int, threads: int) -> Footprint:
    """Make, weigh and measure the bundle of one decoder.

    Args:
        name: name out of `analysis.speed.untrained_graphs.OWN`.
        profile: the nominal device.
        seen: frames of its cameras.
        pages: number of pages to decode.
        threads: threads of one decode.

    Raises:
        BundleError, InvalidInputError: see `untrained_bundle` and `measured`.
    """
    with tempfile.TemporaryDirectory(prefix="lightpage-") as folder:
        path = Path(folder) / "bundle.zip"
        untrained_bundle(path, profile, seen, *OWN[name])
        loading, decoding = measured(path, 0, threads), measured(path, pages, threads)
        return Footprint(name, path.stat().st_size, files_of(path), loading, decoding)


def lines(found: Footprint) -> list[str]:
    """A footprint as a table."""
    pages_ms = [1e3 * seconds for seconds in found.decoding.pages_s]
    return [
        f"{found.decoder:<20} {'zip, MB':>10} {'unpacked, MB':>13}",
        *(f"  {file.name:<18} {_mb(file.stored_bytes):>10} {_mb(file.unpacked_bytes):>13}" for file in found.files),
        f"  {'all':<18} {_mb(found.zip_bytes):>10} {_mb(found.unpacked_bytes):>13}",
        f"  load: {found.loading.load_s:.2f} s, peak memory {_mb(found.loading.peak_bytes)} MB",
        f"  decode: median {np.median(pages_ms):.0f} ms of {len(pages_ms)} pages, "
        f"peak memory {_mb(found.decoding.peak_bytes)} MB",
    ]


def _mb(count: int) -> str:
    return f"{count / 1e6:.2f}" if count < 1e9 else f"{count / 1e6:,.0f}"


@click.command()
@click.option("--profile", "profile_name", default="paper", show_default=True, help="Shipped profile or TOML file.")
@click.option("--decoder", "names", type=click.Choice(list(OWN)), multiple=True, help="Only these; all if left out.")
@click.option("--pages", type=click.IntRange(1, 100), default=3, show_default=True, help="Pages to decode.")
@click.option("--threads", type=click.IntRange(1), help="Threads of one decode; the usable cores if left out.")
@click.option("--set", "settings", multiple=True, metavar="TABLE.KEY=VALUE", help="Change the realistic device.")
@click.option(
    "--recording",
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    help="Take the frames of its first page; a page is simulated if left out, in minutes at full size.",
)
@click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file.")
def main(
    profile_name: str,
    names: tuple[str, ...],
    pages: int,
    threads: int | None,
    settings: tuple[str, ...],
    recording: Path | None,
    json_path: Path | None,
) -> None:
    """Weigh the bundles of untrained decoders, and measure time and memory of loading and decoding.

    A recording is one that `lightpage simulate` made of the same profile and settings.
    """
    profile, device = load_profile(profile_name), Device().with_settings(list(settings))
    threads = threads or available_cpus()
    seen = simulated(profile, device) if recording is None else recorded(recording, profile, device)
    found = []
    for name in dict.fromkeys(names or OWN):
        found.append(footprint(name, profile, seen, pages, threads))
        click.echo("\n".join(lines(found[-1])))
    if json_path is not None:
        figures = {"profile": profile.name, "threads": threads, "settings": list(settings)}
        bundles = [asdict(one) | {"unpacked_bytes": one.unpacked_bytes} for one in found]
        write_figures(json_path, figures | {"bundles": bundles})


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.speed.footprint"))
