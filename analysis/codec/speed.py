"""Time of the page code on one core: numpy and the compiled arithmetic side by side, decoders, a file to pages.

    python -m analysis.codec.speed --json runs/bench-codec/speed.json

What is compared takes turns on the same blocks or pages, so that a machine whose speed drifts tilts nothing. Times are
those of the processor. The installed size says what a decoder would bring into the image.
"""

from __future__ import annotations

import io
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import click
import numpy as np
from numpy.typing import NDArray

from analysis.codec.block_decoders import time_decoders
from analysis.codec.computed_by import computed_by
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.codec.code import Code
from lightpage.codec.compiled.choice import COMPILED, NUMPY, in_use
from lightpage.codec.page_bytes import FileFacts, Header
from lightpage.codec.page_codec import PageCodec
from lightpage.codec.volume import DATA_PAGES, PARITY_PAGES, Volume, encode_volume
from lightpage.device.profile import Profile, load_profile
from lightpage.errors import InvalidInputError
from lightpage.metrics.provenance import write_figures
from lightpage.page.levels import Levels
from lightpage.page.modulation import NOMINAL, Modulation
from lightpage.page.symbols import pilot_mask, pilot_symbols, symbol_phases
from lightpage.recording.pages import PagesWriter

Floats = NDArray[np.float32]
_MARGIN_BITS = 0.1
"""Margin of the pages that are timed, bits a symbol."""
_UNEVEN = Modulation(tuple((NOMINAL.as_dict() | {"stroke_relative": -0.05, "phase_sin_1_rad": 0.1}).values()))
"""A modulator whose levels are not even, as any real one's."""
PAGES: dict[str, tuple[str, int, Code]] = {
    "bench 4x4": ("bench", 4, Code(levels=128, coded_bits=2, rate_per_mille=660, needed_information=0.72)),
    "full size 4x4": ("paper", 4, Code(levels=64, coded_bits=2, rate_per_mille=480, needed_information=0.54)),
    "full size 2x2": ("paper", 2, Code(levels=32, coded_bits=2, rate_per_mille=500, needed_information=0.56)),
}


def drawn_page(codec: PageCodec, pilots: NDArray[np.uint8], levels: Levels) -> tuple[Floats, Floats]:
    """Phases and concentrations of a page that is read with a margin of `_MARGIN_BITS`, as the decoder gives them."""
    rng, code = np.random.default_rng(0), codec.code
    data = rng.integers(0, 256, (1, codec.user_bytes), dtype=np.uint8)
    symbols = codec.encode([Header(code.id, 1, 0, 1)], data, FileFacts(1, 0, 0), pilots)[0]
    for share in np.linspace(0.45, 0.2, 26):
        noise = share * 2 * np.pi / code.levels
        phase = symbol_phases(symbols, levels) + noise * rng.standard_normal(symbols.shape)
        seen = phase.astype(np.float32), np.full(symbols.shape, noise**-2, np.float32)
        if codec.decode(*seen).margin_bits > _MARGIN_BITS:
            return seen
    raise InvalidInputError("page to time", "no margin at any noise", "a code that its page carries")


def time_page(profile: Profile, code: Code, levels: Levels, rounds: int) -> dict[str, Any]:
    """Milliseconds of a page from posterior to checked bytes, numpy and compiled in turns; medians, and their ratio."""
    mask = pilot_mask(profile)
    codec = PageCodec(code, mask, levels)
    seen = drawn_page(codec, pilot_symbols(profile, code.levels)[mask], levels)
    taken: dict[str, list[float]] = {NUMPY: [], COMPILED: []}
    found = {}
    for _ in range(rounds):
        for name, times in taken.items():
            with computed_by(name):
                start = time.process_time()
                found[name] = codec.decode(*seen)
                times.append(time.process_time() - start)
    median = {name: 1e3 * float(np.median(times)) for name, times in taken.items()}
    return {
        **{f"{name}_ms": value for name, value in median.items()},
        "ratio": median[NUMPY] / median[COMPILED],
        "same": found[NUMPY] == found[COMPILED],
        "user_bytes": codec.user_bytes,
        "blocks": codec.blocks,
        "iterations": found[NUMPY].iterations,
    }


def time_encoding(profile: Profile, code: Code, size: int) -> float:
    """Megabytes a second of one core from a file to pages in HDF5, in groups of 60 + 4."""
    mask = pilot_mask(profile)
    codec, content = PageCodec(code, mask), np.random.default_rng(0).bytes(size)
    volume = Volume.of_file(io.BytesIO(content), 1, codec.user_bytes, DATA_PAGES, PARITY_PAGES)
    pilots = pilot_symbols(profile, code.levels)[mask]
    with tempfile.TemporaryDirectory() as folder:
        start = time.process_time()
        with PagesWriter(Path(folder) / "pages.h5", profile, code.levels, {}) as writer:
            for pages in encode_volume(codec, volume, io.BytesIO(content), pilots):
                writer.append(pages)
        return size / (time.process_time() - start) / 1e6


@click.command()
@click.option("--blocks", default=48, show_default=True, type=click.IntRange(16))
@click.option("--rounds", default=5, show_default=True, type=click.IntRange(1))
@click.option("--json", "json_path", type=OutputFile(), help="Write the times to this file.")
def main(blocks: int, rounds: int, json_path: Path | None) -> None:
    """Print the times."""
    found: Any = time_decoders(blocks, rounds)
    click.echo(f"{'rate':<6} {'decoder':<18} {'ms/block':>9} {'Mb/s':>7} {'right':>8} {'MB more':>8}")
    for each in found:
        click.echo(
            f"{each['rate']:<6} {each['decoder']:<18} {each['ms']:>9.2f} {each['megabits_per_second']:>7.2f} "
            f"{each['right']:>4}/{each['blocks']:<3} {each['brought_MB']:>8.0f}"
        )
    pages: dict[str, dict[str, Any]] = {}
    click.echo(
        f"\n{'page':<24} {'bytes':>8} {'blocks':>7} {'iterations':>11} {'numpy ms':>9} {'compiled ms':>12} {'ratio':>6}"
    )
    for name, (profile_name, size, code) in PAGES.items():
        profile = load_profile(profile_name).with_symbols_of(size)
        for suffix, levels in (("", Levels(code.levels)), (", uneven", _UNEVEN.page_levels(code.levels))):
            pages[name + suffix] = times = time_page(profile, code, levels, rounds)
            click.echo(
                f"{name + suffix:<24} {times['user_bytes']:>8} {times['blocks']:>7} {times['iterations']:>11.1f} "
                f"{times['numpy_ms']:>9.1f} {times['compiled_ms']:>12.2f} {times['ratio']:>6.1f}"
                f"{'' if times['same'] else '   NOT THE SAME'}"
            )
    encoding = {}
    for name, (profile_name, size, code) in PAGES.items():
        encoding[name] = time_encoding(load_profile(profile_name).with_symbols_of(size), code, 2_000_000)
        click.echo(f"{name}: a file to pages {encoding[name]:.1f} MB/s")
    found = {"page_code": in_use(), "decoders": found, "pages": pages, "encode_MB_per_second": encoding}
    write_figures(
        json_path, found, pages={name: (profile, size, code.id) for name, (profile, size, code) in PAGES.items()}
    )


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.codec.speed"))
