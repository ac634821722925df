"""AIR of a device whose pages are read by its fitted waves alone, calibrated on two known pages.

    python -m analysis.speed.waves --out D --json F
    python -m analysis.speed.waves --set sensor.full_well_e=32 --pages 24 --out D --json F

A device is simulated and calibrated, and its calibration is exported. Further pages are decoded as a service decodes
them, with each number of steps up to the bundle's. The time of a page is compared with that of the shipped decoder, or
of the bundle `--beside` (a network of the same profile), in turns in the same run. With the figures of `python -m
analysis.comparison.bound`, the AIR is compared with the bound of the light. `--near` spares a large device the search
from nominal. `--out` keeps recording, calibration and bundle, so that an interrupted command can be repeated to
continue.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import click
import numpy as np

from analysis.comparison.data_set import CALIBRATED, bundle_by_waves
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile, OutputFolder
from lightpage.device.profile import load_profile
from lightpage.device.state import Device, draw_device, load_device
from lightpage.metrics.provenance import write_figures
from lightpage.progress import track
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import narrow
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.evaluation import evaluate
from lightpage.runtime.model.bundle.shipped import DEFAULT, bundle_path
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.runtime.model.execution.estimator_graph import NOISE
from lightpage.train.runs import begin

_TIMED = 7
"""Timed inferences of each decoder."""


@dataclass(frozen=True)
class Row:
    """Figures of one number of steps.

    Attributes:
        steps: Gauss-Newton steps.
        air: AIR of pages that were not calibrated on, bits a symbol.
        over_bound: AIR over the bound of the light; None if the bound is not given.
        ece: expected calibration error of the confidences.
        over_claim: claimed information minus the AIR, bits a symbol.
        seconds: median time of a page's inference.
        over_other: this time over that of the shipped decoder, or of the bundle `--beside`.
    """

    steps: int
    air: float
    over_bound: float | None
    ece: float
    over_claim: float
    seconds: float
    over_other: float


def timed(decoders: list[tuple[Decoder, FramePair]]) -> list[float]:
    """Median time of an inference by each decoder, of its own frames, seconds.

    Decoders take turns. Their first inference is not timed.
    """
    seconds: list[list[float]] = [[] for _ in decoders]
    for number in range(_TIMED + 1):
        for times, (decoder, pair) in zip(seconds, decoders, strict=True):
            start = time.perf_counter()
            decoder.infer(pair, doubtful=True)
            if number:
                times.append(time.perf_counter() - start)
    return [float(np.median(times)) for times in seconds]


def _bits(path: Path) -> float:
    """Read the bound of the light, bits a symbol, from a file of `analysis.comparison.bound` or `analysis.results`."""
    document = json.loads(path.read_text("utf-8"))
    return float(document.get("figures", document)["bits"])


@click.command()
@click.option("--profile", "profile_name", default="bench", show_default=True, help="Shipped profile or TOML file.")
@click.option("--symbol-size", type=click.IntRange(1), help="Pixels; the profile's if left out.")
@click.option("--device", "state", type=click.Path(path_type=Path), help="True state (TOML).")
@click.option("--draw", type=click.IntRange(0), help="Seed of a device that is drawn from the capture range.")
@click.option("--set", "settings", multiple=True, metavar="TABLE.KEY=VALUE", help="Number of the true state to change.")
@click.option("--pages", default=24, show_default=True, type=click.IntRange(1), help="Pages that are read.")
@click.option("--levels", default=256, show_default=True, type=click.IntRange(2, 256), help="Levels of the pages.")
@click.option("--seed", default=7000, show_default=True, type=click.IntRange(0), help="Seed of pages and noise.")
@click.option("--bound", type=click.Path(path_type=Path), help="Figures of `analysis.comparison.bound` of this light.")
@click.option("--near", type=click.Path(path_type=Path), help="Calibration of the device from which the fit starts.")
@click.option("--beside", type=click.Path(path_type=Path), help="Bundle whose time is compared; the shipped one.")
@click.option("--out", type=OutputFolder(), required=True, help="Folder that keeps recording, calibration and bundle.")
@click.option("--json", "json_path", type=OutputFile(), required=True)
def main(
    profile_name: str,
    symbol_size: int | None,
    state: Path | None,
    draw: int | None,
    settings: tuple[str, ...],
    pages: int,
    levels: int,
    seed: int,
    bound: Path | None,
    near: Path | None,
    beside: Path | None,
    out: Path,
    json_path: Path,
) -> None:
    """Print AIR, its share of the bound and time by the number of steps."""
    profile = load_profile(profile_name)
    profile = profile.with_symbols_of(symbol_size or profile.page.symbol_size_px)
    if draw is not None:
        device = draw_device(np.random.default_rng(draw))
    else:
        device = Device() if state is None else load_device(state)
    device = device.of_profile(profile).with_settings([*settings])
    asked = {"--profile": profile.to_toml(), "device": device.model_dump(mode="json"), "--pages": pages}
    asked |= {"--levels": levels, "--seed": seed, "--near": near and str(near)}
    out.mkdir(parents=True, exist_ok=True)
    begin(out, asked)
    recording, bundle = bundle_by_waves(out, profile, device, pages, seed, levels, near)
    limit = None if bound is None else _bits(bound)
    most = len(Decoder.load(bundle).graph.value(NOISE)) - 1
    decoders = [Decoder.load(bundle, steps=steps) for steps in range(1, most + 1)]
    rows = []
    with Recording.open(recording) as file:
        compared = Decoder.load(bundle_path(DEFAULT) if beside is None else beside)
        pair = narrow(file.frames(CALIBRATED), file.bit_depth)
        own = compared.bundle.golden.pair  # cameras may have another bit depth
        other, *seconds = timed([(compared, own), *((decoder, pair) for decoder in decoders)])
        timed_decoders = zip(track(decoders, "decode", unit="number of steps"), seconds, strict=True)
        for steps, (decoder, duration) in enumerate(timed_decoders, 1):
            figures = evaluate(decoder, file, tracker_for(decoder)).figures
            air = figures.air_bits_per_symbol
            share = None if limit is None else air / limit
            rows.append(
                Row(
                    steps=steps,
                    air=air,
                    over_bound=share,
                    ece=figures.ece,
                    over_claim=figures.over_claim_bits_per_symbol,
                    seconds=duration,
                    over_other=duration / other,
                )
            )
    for row in rows:
        of_bound = "" if row.over_bound is None else f", {row.over_bound:.4f} of the bound"
        click.echo(
            f"{row.steps} steps: AIR {row.air:.4f}{of_bound}; over-claim {row.over_claim:+.3f}, ECE {row.ece:.4f}; "
            f"{1000 * row.seconds:.0f} ms, {row.over_other:.2f} of the other decoder's"
        )
    write_figures(json_path, {"asked": asked, "bound": limit, "rows": [asdict(row) for row in rows]}, asked=asked)


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.speed.waves"))
