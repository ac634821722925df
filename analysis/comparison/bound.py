"""The bound of the light: what a decoder could read at most of a device, whatever it is.

    python -m analysis.comparison.bound --json F
    python -m analysis.comparison.bound --set sensor.full_well_e=32 --pages 8 --symbols 100 --json F
    python -m analysis.comparison.bound --draw 1000 --json F

Symbols of random pages are drawn; of each, all others and the device are taken as known (see
`lightpage.simulator.light_bound`). The least error of its phase is that of a von Mises posterior, whose information on
one of M levels is the bound, bits. The standard error is that of the mean over all symbols. Interrupted, it goes on
from the JSON file.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import click
import numpy as np

from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.device.profile import load_profile
from lightpage.device.state import Device, draw_device, load_device
from lightpage.errors import InvalidInputError
from lightpage.metrics.provenance import write_figures
from lightpage.page.levels import MAX_LEVELS, MIN_LEVELS
from lightpage.progress import track
from lightpage.simulator.light_bound import mean_information, sampled_concentrations


def earlier(path: Path, asked: dict[str, object]) -> list[list[float]]:
    """Concentrations by page that a run which was told the same has kept.

    Raises:
        InvalidInputError: the file is of another run.
    """
    if not path.exists():
        return []
    try:
        kept = json.loads(path.read_text("utf-8"))
        told, pages = kept["asked"], kept["concentrations"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InvalidInputError(f"--json {path}", error, "a file of this command, or a new name") from None
    if told != asked:
        raise InvalidInputError(f"--json {path}", f"figures of {told}", f"those of {asked}, or a new name")
    return [list(map(float, page)) for page in pages]


@click.command()
@click.option("--profile", "profile_name", default="bench", show_default=True, help="Shipped profile or TOML file.")
@click.option("--symbol-size", type=click.IntRange(1), help="Pixels; the profile's if left out.")
@click.option("--device", "state", type=click.Path(path_type=Path), help="True state (TOML).")
@click.option("--draw", type=click.IntRange(0), help="Seed of a device that is drawn from the capture range.")
@click.option(
    "--set",
    "settings",
    multiple=True,
    metavar="TABLE.KEY=VALUE",
    help="Number of the true state to change, TABLE.KEY=VALUE.",
)
@click.option("--levels", type=click.IntRange(MIN_LEVELS, MAX_LEVELS), default=MAX_LEVELS, show_default=True)
@click.option("--pages", default=4, show_default=True, type=click.IntRange(1))
@click.option("--symbols", default=100, show_default=True, type=click.IntRange(2), help="Symbols of each page.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(0))
@click.option("--json", "json_path", type=OutputFile(), required=True)
def main(
    profile_name: str,
    symbol_size: int | None,
    state: Path | None,
    draw: int | None,
    settings: tuple[str, ...],
    levels: int,
    pages: int,
    symbols: int,
    seed: int,
    json_path: Path,
) -> None:
    """Print the bound with its standard error, bits a symbol."""
    profile = load_profile(profile_name)
    profile = profile.with_symbols_of(symbol_size or profile.page.symbol_size_px)
    if draw is not None:
        device = draw_device(np.random.default_rng(draw))
    else:
        device = Device() if state is None else load_device(state)
    device = device.of_profile(profile).with_settings([*settings])
    asked: dict[str, object] = {
        "profile": profile.to_toml(),
        "device": device.model_dump(mode="json"),
        "levels": levels,
        "symbols": symbols,
        "seed": seed,
    }
    found = earlier(json_path, asked)
    for page in track(range(len(found), pages), "bound", unit="page"):
        found.append([*sampled_concentrations(profile, device, levels, symbols, (seed, page))])
        write_figures(json_path, {"asked": asked, "concentrations": found}, asked=asked)
    each = [one for page in found for one in page]
    mean, error = mean_information(each, levels, seed)
    figures = {"bits": mean, "standard_error": error, "concentrations": found}
    write_figures(json_path, {"asked": asked, **figures}, asked=asked)
    click.echo(f"bound {mean:.3f} +- {error:.3f} bits a symbol, {len(each)} symbols")


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.comparison.bound"))
