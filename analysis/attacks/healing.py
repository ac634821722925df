"""Pages that must not move a model: what of them does a healing take, and what does it cost?

    python -m analysis.attacks.healing --tries 200 --json F

Each try gives a model six pages as if it had lost them: noise, light of the device that carries no page of its code, or
one page again and again. Where the healing brings a bundle, that must not read fresh pages of the device worse than the
one before. An interrupted run goes on: tries that are in the JSON file are not made again.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path

import click
import numpy as np

from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.codec.page_bytes import FileFacts, Header
from lightpage.codec.page_codec import PageCodec
from lightpage.device.state import Device, draw_device
from lightpage.errors import InvalidInputError, RecalibrationRefusedError
from lightpage.metrics.measures import measure
from lightpage.metrics.provenance import write_figures
from lightpage.page.pilots import Pilots
from lightpage.page.symbols import random_symbols
from lightpage.progress import track
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.bundle.shipped import bundle_path
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.recalibration.healed_bundle import recalibrate_by_lost
from lightpage.runtime.recalibration.healing import TOGETHER, LostPages
from lightpage.runtime.recalibration.refit import refit
from lightpage.simulator.simulator import Simulator

WORSE_BITS = 0.02
"""AIR that a model may lose by what it has learnt: another re-fit of the same device differs by as much."""


@dataclass(frozen=True)
class Try:
    """Outcome of a try: AIRs of two fresh pages of the device, bits a symbol, and why nothing was taken, if so."""

    kind: str
    seed: int
    refused: str
    before: float
    after: float
    seconds: float

    @property
    def moved_for_the_worse(self) -> bool:
        """True where the model reads its device worse than before."""
        return self.after < self.before - WORSE_BITS


class _Attack:
    """A model, its device, and pages that are no lost pages of it."""

    def __init__(self, decoder: Decoder) -> None:
        self.decoder = decoder
        self.profile, self.code = decoder.bundle.profile, decoder.page_codec.code

    def kinds(self) -> dict[str, Callable[[int], list[FramePair]]]:
        """Makers of a try's pages from its seed, by name."""
        return {
            "noise": self.noise,
            "symbols at random": lambda seed: self.seen(self.at_random(seed), seed),
            "pages of another code": lambda seed: self.seen(self.of_another_code(seed), seed),
            "one page again and again": lambda seed: self.seen(self.coded(1, seed), seed) * TOGETHER,
            "quadrature of the page before": self.mixed,
            "another device, far away": self.far_away,
            "mirrored": self.mirrored,
            "a speck of light": self.speck,
        }

    def seen(self, symbols: np.ndarray, seed: int, device: Device | None = None) -> list[FramePair]:
        """Frames of pages, by default of the model's device after its pipe has turned by a twentieth of a degree."""
        turned = self.own.with_settings(["geometry.pipe_angle_deg=-0.55"])
        simulator = Simulator(self.profile, device or turned, self.code.levels, seed)
        return [simulator.page(page) for page in symbols]

    @cached_property
    def own(self) -> Device:
        """The device that the model was trained for."""
        return Device().of_profile(self.profile)

    def coded(self, count: int, seed: int, codec: PageCodec | None = None) -> np.ndarray:
        """Pages of user data, uint8 [count, ny, nx]."""
        codec = codec or self.decoder.page_codec
        data = np.random.default_rng(seed).integers(0, 256, (count, codec.user_bytes), dtype=np.uint8)
        headers = [Header(codec.code.id, seed, page, count * codec.user_bytes) for page in range(count)]
        written = self.decoder.bundle.written_pilots(codec.code.levels)
        return codec.encode(headers, data, FileFacts(count, 0, 0), written)

    def at_random(self, seed: int) -> np.ndarray:
        """Pages whose pilots alone are right."""
        pages = random_symbols(self.profile, self.code.levels, TOGETHER, np.random.default_rng(seed))
        pages[:, self.decoder.bundle.pilot_mask] = self.decoder.bundle.written_pilots(self.code.levels)
        return pages

    def of_another_code(self, seed: int) -> np.ndarray:
        """Pages of user data of a code that has another rate."""
        other = self.code.model_copy(update={"rate_per_mille": self.code.rate_per_mille - 100})
        bundle = self.decoder.bundle
        codec = PageCodec(other, bundle.pilot_mask, bundle.levels(other.levels))
        return self.coded(TOGETHER, seed, codec)

    def noise(self, seed: int) -> list[FramePair]:
        """The counts of pages, each frame's shuffled."""
        rng = np.random.default_rng(seed)

        def shuffled(frame: np.ndarray) -> np.ndarray:
            return np.asarray(rng.permutation(frame.ravel()).reshape(frame.shape))

        pairs = self.seen(self.coded(TOGETHER, seed), seed)
        return [FramePair(shuffled(pair.in_phase), shuffled(pair.quadrature)) for pair in pairs]

    def mixed(self, seed: int) -> list[FramePair]:
        """Frames of two pages as a pair."""
        pairs = self.seen(self.coded(TOGETHER, seed), seed)
        return [
            FramePair(one.in_phase, other.quadrature)
            for one, other in zip(pairs, [pairs[-1], *pairs[:-1]], strict=True)
        ]

    def mirrored(self, seed: int) -> list[FramePair]:
        """Pages as a mirror shows them."""
        pairs = self.seen(self.coded(TOGETHER, seed), seed)
        return [FramePair(*(np.ascontiguousarray(f[:, ::-1]) for f in (p.in_phase, p.quadrature))) for p in pairs]

    def far_away(self, seed: int) -> list[FramePair]:
        """Pages of user data on a device drawn from the whole capture range."""
        return self.seen(self.coded(TOGETHER, seed), seed, draw_device(np.random.default_rng(seed)))

    def speck(self, seed: int) -> list[FramePair]:
        """Pages of which a bright speck hides three quarters."""
        pairs = self.seen(self.coded(TOGETHER, seed), seed)
        for pair in pairs:
            for frame in (pair.in_phase, pair.quadrature):
                frame[: 3 * len(frame) // 4] = frame.max()
        return pairs

    @cached_property
    def fresh(self) -> tuple[list[FramePair], np.ndarray]:
        """Two pages of the device as the model knows it, and their symbols."""
        symbols = self.coded(2, 1 << 20)
        return self.seen(symbols, 1 << 20, self.own), symbols

    def air(self, decoder: Decoder) -> float:
        """Return the mean AIR of the fresh pages, bits a symbol."""
        bundle, found = decoder.bundle, list[float]()
        levels, data = bundle.levels(self.code.levels), ~bundle.pilot_mask
        for pair, symbols in zip(*self.fresh, strict=True):
            pilots = Pilots.of_symbols(bundle.pilot_mask, symbols, levels)
            page = decoder.post_process(decoder.infer(pair, doubtful=True), levels.count, pilots)
            read = measure(page.phase[data], page.concentration[data], symbols[data], levels)
            found.append(read.air_bits_per_symbol)
        return float(np.mean(found))

    def tried(self, kind: str, seed: int, folder: Path) -> Try:
        """Make a try."""
        out, refused, begun = folder / f"{seed}.zip", "", time.process_time()
        lost = LostPages(tuple(self.kinds()[kind](seed)), self.code)
        try:
            recalibrate_by_lost(self.decoder, lost, out, f"tried-{seed}", refit, lambda what, share: None)
        except RecalibrationRefusedError as error:
            refused = str(error)
        seconds, before = time.process_time() - begun, self.air(self.decoder)
        after = before if refused else self.air(Decoder.load(out))
        return Try(kind, seed, refused, before, after, seconds)


@click.command()
@click.option("--bundle", default="bench", show_default=True, help="A bundle's path, or the name of a shipped one.")
@click.option("--tries", default=200, show_default=True, type=click.IntRange(1), help="Evenly of all kinds.")
@click.option("--json", "json_path", required=True, type=OutputFile())
def main(bundle: str, tries: int, json_path: Path) -> None:
    """Give a model pages that it must not learn from."""
    kept = json.loads(json_path.read_text("utf-8")) if json_path.exists() else {}
    done = [Try(**one) for one in kept.get("tries", ()) if kept.get("bundle") == bundle]
    attack = _Attack(Decoder.load(bundle_path(bundle)))
    kinds = list(attack.kinds())
    with tempfile.TemporaryDirectory() as folder:
        for seed in track(list(range(len(done), tries)), "try", unit="try"):
            done.append(attack.tried(kinds[seed % len(kinds)], seed, Path(folder)))
            write_figures(json_path, {"bundle": bundle, "tries": [asdict(one) for one in done]})
    for kind in kinds:
        own = [one for one in done if one.kind == kind]
        taken = sum(not one.refused for one in own)
        worst = min((one.after - one.before for one in own), default=0.0)
        seconds = max((one.seconds for one in own), default=0.0)
        click.echo(
            f"{kind:<32} {len(own):>4} tries, {taken:>3} taken, at worst {worst:+.3f} bit, {seconds:.0f} s at most"
        )
    worse = [f"{one.kind} (seed {one.seed})" for one in done if one.moved_for_the_worse]
    if worse:
        raise InvalidInputError("models moved for the worse", ", ".join(worse), "none")
    click.echo(f"none of {len(done)} has moved the model for the worse")


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.attacks.healing"))
