"""Check that no wrong byte is ever given out: pages drawn at and below the code's limit, and pages damaged every way.

    python -m analysis.codec.safety --json runs/bench-codec/safety.json

A healing takes the symbols of LDPC blocks that converge on pages which are lost. So the lost pages of all noises are
counted too on which blocks converge, and those of them on which a block is another word than was sent.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import click
import numpy as np
from numpy.typing import NDArray

from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.codec.code import Code
from lightpage.codec.page_bytes import FileFacts, Header
from lightpage.codec.page_codec import PageCodec
from lightpage.device.profile import load_profile
from lightpage.errors import LightpageError
from lightpage.metrics.provenance import write_figures
from lightpage.page.symbols import pilot_mask, pilot_symbols, symbol_phases
from lightpage.progress import track
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.bundle.shipped import bundle_path

Floats = NDArray[np.float64]
Damage = Callable[[Floats, Floats, np.random.Generator], None]

NOISES = (0.97, 0.99, 1.0, 1.01, 1.03, 1.1, 1.3, 2.0)
"""Factors on the noise at which half of the pages are lost: from just below it to far beyond."""
_LIMIT_PAGES, _LIMIT_STEPS = 20, 10


@dataclass(frozen=True)
class Count:
    """Count of pages by outcome.

    Attributes:
        right, lost, wrong: how many gave their bytes, gave none, or gave others.
    """

    right: int = 0
    lost: int = 0
    wrong: int = 0


class Drawn(NamedTuple):
    """A page with what was sent."""

    sent: bytes
    header: Header
    phase: Floats
    concentration: Floats
    symbols: NDArray[np.uint8]


class Pages:
    """Pages of random bytes on the bench device.

    Args:
        code: code of the pages.
        seed: seed of bytes and noise.
    """

    def __init__(self, code: Code, seed: int) -> None:
        profile = load_profile("bench")
        mask = pilot_mask(profile)
        self.codec, self.rng = PageCodec(code, mask), np.random.default_rng(seed)
        self._pilots = pilot_symbols(profile, code.levels)[mask]

    def drawn(self, noise_rad: float) -> Drawn:
        """Return a page with its phases and concentrations in so much noise."""
        code, rng = self.codec.code, self.rng
        header = Header(code.id, int(rng.integers(1 << 32)), int(rng.integers(1 << 24)), int(rng.integers(1 << 40)))
        data = rng.integers(0, 256, (1, self.codec.user_bytes), dtype=np.uint8)
        symbols = self.codec.encode([header], data, FileFacts(60, 4, int(rng.integers(1 << 32))), self._pilots)[0]
        phase = symbol_phases(symbols, code.levels) + noise_rad * rng.standard_normal(symbols.shape)
        return Drawn(data.tobytes(), header, phase, np.full(symbols.shape, noise_rad**-2), symbols)

    def limit(self) -> float:
        """Phase noise at which about half of the pages are lost, radians."""
        low, high = 0.0, 2 * np.pi / self.codec.code.levels
        for _ in range(_LIMIT_STEPS):
            noise = (low + high) / 2
            lost = sum(self.outcome(self.drawn(noise)) == "lost" for _ in range(_LIMIT_PAGES))
            low, high = (noise, high) if 2 * lost < _LIMIT_PAGES else (low, noise)
        return (low + high) / 2

    def outcome(self, page: Drawn) -> str:
        """Decode a page, and return its outcome: right, lost or wrong."""
        try:
            found = self.codec.decode(page.phase, page.concentration)
        except LightpageError:
            return "lost"
        if found.data is None:
            return "lost"
        return "right" if (found.data, found.header) == (page.sent, page.header) else "wrong"

    def settled(self, page: Drawn) -> str:
        """Return whether blocks of a page converge: none, right or wrong, where one of them is another word."""
        decided, settled = self.codec.decide(page.phase, page.concentration)
        if not settled.any():
            return "none"
        coset = 1 << self.codec.code.coded_bits
        return "right" if np.array_equal(decided[settled] % coset, page.symbols[settled] % coset) else "wrong"


def _patch(phase: Floats, concentration: Floats, rng: np.random.Generator) -> None:
    """A scratch: a rectangle of noise that claims to be certain."""
    rows, columns = phase.shape
    height, width = (int(length ** rng.uniform(0, 1)) for length in phase.shape)
    y, x = rng.integers(0, rows - height + 1), rng.integers(0, columns - width + 1)
    phase[y : y + height, x : x + width] = rng.uniform(-np.pi, np.pi, (height, width))


def _turned(phase: Floats, concentration: Floats, rng: np.random.Generator) -> None:
    """A wrong piston."""
    phase += rng.uniform(-np.pi, np.pi)


def _rolled(phase: Floats, concentration: Floats, rng: np.random.Generator) -> None:
    """An image that lies some symbols off."""
    phase[...] = np.roll(phase, rng.integers(1, 10, 2), axis=(0, 1))


def _dark(phase: Floats, concentration: Floats, rng: np.random.Generator) -> None:
    """Symbols of which nothing is known."""
    concentration[rng.random(phase.shape) < rng.uniform(0.05, 1.0)] = 0


def _sure(phase: Floats, concentration: Floats, rng: np.random.Generator) -> None:
    """Noise throughout, claimed to be certain."""
    phase[...] = rng.uniform(-np.pi, np.pi, phase.shape)
    concentration[...] = 1e6


def _few(phase: Floats, concentration: Floats, rng: np.random.Generator) -> None:
    """Turn the phases of a few symbols to other levels, without lowering their concentration."""
    wrong = rng.random(phase.shape) < 10 ** rng.uniform(-4, -1)
    phase[wrong] += rng.uniform(-np.pi, np.pi, int(wrong.sum()))


DAMAGES: dict[str, Damage] = {
    "scratch": _patch,
    "piston": _turned,
    "image off": _rolled,
    "dark": _dark,
    "noise": _sure,
    "few wrong": _few,
}


def counted(outcomes: Counter[str]) -> Count:
    """Outcomes by name."""
    return Count(outcomes["right"], outcomes["lost"], outcomes["wrong"])


@click.command()
@click.option("--pages", "count", default=30_000, show_default=True, type=click.IntRange(1), help="Pages at the limit.")
@click.option("--damaged", default=10_000, show_default=True, type=click.IntRange(1), help="Damaged pages.")
@click.option("--corrections", default=3, show_default=True, type=click.IntRange(0, 32), help="t, so that words mend.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(0))
@click.option("--json", "json_path", type=OutputFile(), help="Write the counts to this file.")
def main(count: int, damaged: int, corrections: int, seed: int, json_path: Path | None) -> None:
    """Count pages that gave wrong bytes; any makes the exit status 1."""
    shipped = Bundle.open(bundle_path("bench")).code
    assert shipped is not None  # the shipped bundle has a code
    pages = Pages(shipped.model_copy(update={"corrections": corrections}), seed)
    counts: dict[str, Counter[str]] = {}
    settled = Counter[str]()
    limit = pages.limit()
    click.echo(f"half of the pages are lost at a phase noise of {limit:.4f} rad")
    for index in track(range(count), "pages at the limit"):
        share = NOISES[index % len(NOISES)]
        drawn = pages.drawn(share * limit)
        outcome = pages.outcome(drawn)
        counts.setdefault(f"noise {share:g} of the limit", Counter())[outcome] += 1
        if outcome == "lost":
            settled[pages.settled(drawn)] += 1
    names = list(DAMAGES)
    for index in track(range(damaged), "damaged pages"):
        name = names[index % len(names)]
        drawn = pages.drawn(0.9 * limit)
        DAMAGES[name](drawn.phase, drawn.concentration, pages.rng)
        counts.setdefault(name, Counter())[pages.outcome(drawn)] += 1
    click.echo(f"{'pages':<24} {'right':>7} {'lost':>7} {'wrong':>7}")
    for name, outcomes in counts.items():
        of = counted(outcomes)
        click.echo(f"{name:<24} {of.right:>7} {of.lost:>7} {of.wrong:>7}")
    converged = settled["right"] + settled["wrong"]
    click.echo(f"of {settled.total()} lost pages blocks converge on {converged}, on {settled['wrong']} to another word")
    if json_path is not None:
        figures = {name: vars(counted(outcomes)) for name, outcomes in counts.items()}
        write_figures(
            json_path, figures | {"converged on lost pages": {"right": settled["right"], "wrong": settled["wrong"]}}
        )
    if any(outcomes["wrong"] for outcomes in counts.values()):
        raise click.exceptions.Exit(1)


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.codec.safety"))
