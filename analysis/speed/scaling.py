"""Time per symbol of a decoder in the runtime, page and frames growing together, the symbol's size fixed.

    python -m analysis.speed.scaling

`lightpage study scaling` compares it with other decoders, all in torch.
"""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass
from pathlib import Path

import click
import numpy as np

from analysis.speed.decode_time import frames_of, opened, seconds_of
from analysis.speed.untrained_graphs import makers, makers_of
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.device.profile import load_profile
from lightpage.export.onnx_files import decoder_onnx
from lightpage.metrics.provenance import write_figures
from lightpage.runtime.model.execution.cpus import available_cpus
from lightpage.study.studies.scaling import enlarged


@dataclass(frozen=True)
class Scaled:
    """Median seconds of a page."""

    symbols: int
    seconds: float

    @property
    def each_us(self) -> float:
        """Microseconds a symbol."""
        return 1e6 * self.seconds / self.symbols


@click.command()
@click.option("--profile", "profile_name", default="bench", show_default=True, help="The smallest device.")
@click.option(
    "--decoder", "name", default="coherent", show_default=True, help="Decoder, as `analysis.speed.speed` names it."
)
@click.option("--factor", "factors", type=click.IntRange(1, 16), multiple=True, default=(1, 2, 4, 8), show_default=True)
@click.option("--repeats", type=click.IntRange(1, 1000), default=5, show_default=True)
@click.option("--threads", type=click.IntRange(1), help="Threads of one decode; the usable cores if left out.")
@click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file.")
def main(
    profile_name: str, name: str, factors: tuple[int, ...], repeats: int, threads: int | None, json_path: Path | None
) -> None:
    """Time pages of devices that are so many times as large along each axis."""
    smallest, threads = load_profile(profile_name), threads or available_cpus()
    makers_of(smallest, [name])
    results = []
    click.echo(f"{'symbols':>8} {'ms a page':>10} {'us a symbol':>12} {'over the smallest':>18}")
    for factor in sorted(set(factors)):
        profile = enlarged(smallest, factor)
        decoder, tensors = makers(profile)[name]()
        model = decoder_onnx(decoder.eval(), "uint8", profile.frame_shape, tensors)
        session, feeds = opened(model, threads), frames_of(profile)
        session.run(["p"], feeds)
        seconds = [seconds_of(session, feeds) for _ in range(repeats)]
        results.append(Scaled(profile.page.columns * profile.page.rows, float(np.median(seconds))))
        last, over = results[-1], results[-1].each_us / results[0].each_us
        click.echo(f"{last.symbols:>8,} {1e3 * last.seconds:>10.1f} {last.each_us:>12.2f} {over:>18.3f}")
    if json_path is not None:
        figures = {"profile": smallest.name, "decoder": name, "threads": threads, "repeats": repeats}
        write_figures(json_path, figures | {"pages": [asdict(result) for result in results]})


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.speed.scaling"))
