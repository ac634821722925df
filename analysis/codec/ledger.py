"""The ledger of user bytes: a random file through simulated devices, on pages that no decoder was trained on.

    python -m analysis.codec.ledger --out runs/bench-codec

For each data set: the bundle's code is taken, or one is chosen on held-out pages. A random file is put on as many pages
as are asked for, the device shows them, and the file is read back from frames and pilots. Interrupted, it goes on where
it was.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np
from scipy.stats import binom

from analysis.comparison.data_set import bundle_by_waves, data_set_of, simulate
from analysis.comparison.kept_bundle import export_kept
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFolder
from lightpage.codec.code import load_code
from lightpage.codec.erasure import MOST_GROUP_PAGES
from lightpage.codec.page_codec import PageCodec
from lightpage.codec.volume import DATA_PAGES, PARITY_PAGES, Volume, encode_volume
from lightpage.device.profile import Profile, load_profile
from lightpage.device.state import Device
from lightpage.metrics.provenance import write_figures
from lightpage.recording.pages import Pages, PagesWriter
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.coded_pages import choose_code
from lightpage.runtime.archives.recordings.recovery import Recovery, recover
from lightpage.runtime.model.bundle.shipped import bundle_path
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.simulator.recording_job import RecordingJob
from lightpage.train.models.decoder import COHERENT, WAVE
from lightpage.train.models.presets import FAST

WEIGHTS = Path("analysis/weights")
LOSS = 1e-6
"""Probability that a data page is lost behind the outer code."""
VOLUME = 7
_SEED = 90_000
_KNOWN = 20
"""Pages on which the code of a bundle by the waves is chosen."""


@dataclass(frozen=True)
class DataSet:
    """A device with the decoder that reads it.

    Attributes:
        name: name for people and files.
        bundle: makes the bundle's path, in a folder.
        profile: nominal device.
        device: true state.
        known: pages that the code is chosen on.
        pages: number of pages that the file fills.
    """

    name: str
    bundle: Callable[[Path], Path]
    profile: Profile
    device: Device
    known: int
    pages: int


def _kept(folder: str, method: str = COHERENT, refinements: int = 1) -> Callable[[Path], Path]:
    def made(work: Path) -> Path:
        out = work / "kept.zip"
        if not out.exists():
            export_kept(WEIGHTS / folder, work / "kept", out, method, refinements)
        return out

    return made


def data_sets(pages: int) -> dict[str, DataSet]:
    """Every data set by name; `pages` are those of the bench device."""

    def kept(name: str, folder: str, known: int, pages: int, *method: Any) -> DataSet:
        profile, device, _ = data_set_of(WEIGHTS / folder)
        return DataSet(name, _kept(folder, *method), profile, device, known, pages)

    def by_waves(name: str, folder: str, pages: int) -> DataSet:
        profile, device, _ = data_set_of(WEIGHTS / folder)
        near = WEIGHTS / folder / "calibration.toml" if profile.name == "paper" else None

        def made(work: Path) -> Path:
            return bundle_by_waves(work / "device", profile, device, _KNOWN, _SEED, near=near)[1]

        return DataSet(name, made, profile, device, 0, pages)

    sets = [
        DataSet("bright", lambda _: bundle_path("bench"), load_profile("bench"), Device(), 120, pages),
        by_waves("32e waves", "bench/-0.6deg-32e-4px", pages),
        kept("32e", "bench/-0.6deg-32e-4px", 120, pages),
        by_waves("full-size 4x4 waves", "paper/-0.6deg-32e-4px", 4),
        kept("full-size 4x4", "paper/-0.6deg-32e-4px", 8, 4),
        kept("full-size 4x4 standard", "paper/-0.6deg-32e-4px", 8, 4, WAVE, 0),
        kept("full-size 4x4 fast", "paper/-0.6deg-32e-4px", 8, 4, FAST, 0),
        kept("full-size 2x2", "paper/-0.6deg-32e-2px", 8, 4),
    ]
    return {each.name: each for each in sets}


def photograph(data: DataSet, symbols: Path, path: Path, seed: int) -> None:
    """Record the pages of a file on the device of a data set; a recording that is there stays."""
    if path.exists():
        return
    with Pages.open(symbols) as written:
        job = RecordingJob(data.profile, data.device, written.levels, seed, truth=False, out=path, written=written)
        job.claim(force=False)
        job.run(len(written))


def through(data: DataSet, folder: Path) -> Recovery:
    """Carry a file through a data set; what is made on the way lies in `folder`, and is kept."""
    folder.mkdir(parents=True, exist_ok=True)
    decoder = Decoder.load(data.bundle(folder))
    code_path, pages, sent = folder / "code.toml", folder / "pages.h5", folder / "sent.bin"
    if decoder.bundle.code is not None:
        decoder.bundle.code.save(code_path)
    elif not code_path.exists():
        simulate(folder / "known.h5", data.profile, data.device, data.known, _SEED)
        with Recording.open(folder / "known.h5") as recording:
            best, _ = choose_code(decoder, recording, tracker_for(decoder))
        best.code.save(code_path)
    code = load_code(code_path)
    codec = PageCodec(code, decoder.bundle.pilot_mask)
    if not pages.exists():
        groups = max(1, round(data.pages / (DATA_PAGES + PARITY_PAGES)))
        parity = PARITY_PAGES if data.pages > PARITY_PAGES else 1
        share = -(-(data.pages - groups * parity) // groups)
        content = np.random.default_rng(_SEED).bytes(codec.user_bytes * (data.pages - groups * parity))
        sent.write_bytes(content)
        with sent.open("rb") as file:
            volume = Volume.of_file(file, VOLUME, codec.user_bytes, share, parity)
            with PagesWriter(pages, data.profile, code.levels, code.model_dump() | volume.to_json()) as writer:
                for some in encode_volume(codec, volume, file, decoder.bundle.written_pilots(code.levels)):
                    writer.append(some)
    photograph(data, pages, folder / "shown.h5", _SEED + 1)
    read = folder / "read.bin"
    with Recording.open(folder / "shown.h5") as recording:
        found = recover(decoder, recording, tracker_for(decoder), code, read)
    if not found.lost and read.read_bytes() != sent.read_bytes():
        raise AssertionError(f"{data.name}: wrong bytes were given out")
    return found


def outer_share(page_loss: float) -> tuple[float, int, int]:
    """The largest share of data pages in a group that loses a data page with a probability of at most `LOSS`, and k, m.

    Args:
        page_loss: probability that a page gives no bytes, independent of the others.
    """
    best = (0.0, 1, MOST_GROUP_PAGES - 1)
    for parity in range(MOST_GROUP_PAGES - 1):
        # the most data pages beside so many parity pages
        for size in range(MOST_GROUP_PAGES, parity, -1):
            lost = np.arange(parity + 1, size + 1)
            if float(np.sum(binom.pmf(lost, size, page_loss) * lost) / size) <= LOSS:
                best = max(best, ((size - parity) / size, size - parity, parity))
                break
    return best


def line(name: str, figures: dict[str, Any]) -> str:
    """A data set for people."""
    share, k, m = figures["outer_share"], figures["outer_data_pages"], figures["outer_parity_pages"]
    return (
        f"{name:<22} {figures['pages']:>6} {figures['pages_unread']:>7} {figures['page_failure_rate_bound_95']:>8.4f} "
        f"{figures['user_bytes_per_page']:>8} {figures['air_bytes_per_page']:>8.0f} {figures['share_of_air']:>7.4f} "
        f"{share * figures['share_of_air']:>7.4f} {f'({k + m}, {k})':>11} {figures['Q']:>6.3f} {figures['q']:>6.3f} "
        f"{figures['margin_bits_least']:>7.3f} {1e3 * figures['code_seconds_per_page']:>8.1f} "
        f"{1e3 * figures['seconds_per_page']:>9.0f}"
    )


HEADER = (
    f"{'data set':<22} {'pages':>6} {'unread':>7} {'bound':>8} {'bytes':>8} {'AIR':>8} {'share':>7} {'outer':>7} "
    f"{'(n, k)':>11} {'Q':>6} {'q':>6} {'margin':>7} {'code ms':>8} {'page ms':>9}"
)
"""Pages, those that gave no bytes and the 95% bound of their rate; user bytes of a page, bytes of its AIR, their ratio,
and that behind an outer code (n, k) that loses at most one data page of a million at that bound; user bits a symbol,
and over the raw bits; least margin, bits a symbol; time of the code and of the whole page."""


@click.command()
@click.option("--out", type=OutputFolder(), required=True, help="Folder for pages, recordings and ledger.json.")
@click.option("--pages", default=320, show_default=True, type=click.IntRange(8), help="Pages of the bench device.")
@click.option("--data-set", "names", multiple=True, type=click.Choice(list(data_sets(8))), help="Default: all.")
def main(out: Path, pages: int, names: tuple[str, ...]) -> None:
    """Print the net user bytes of every data set."""
    sets = data_sets(pages)
    ledger: dict[str, Any] = {}
    click.echo(HEADER)
    for name in names or tuple(sets):
        found = through(sets[name], out / name.replace(" ", "-"))
        share, data, parity = outer_share(found.failure_bound)
        figures = {key: value for key, value in found.to_json().items() if key != "page_results"}
        figures |= {"outer_share": share, "outer_data_pages": data, "outer_parity_pages": parity}
        figures["margins"] = [page.margin_bits for page in found.pages]
        figures["losses"] = [asdict(page) for page in found.unread]
        ledger[name] = figures
        write_figures(out / "ledger.json", ledger, bundle=bundle_path("bench"), weights=WEIGHTS)
        click.echo(line(name, figures))


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.codec.ledger"))
