"""Prints the share of wrong symbols that `lightpage.load(...).decode` reads on some pages of a drifting recording.

`lightpage simulate --profile bench --pages 30 --seed 2 --out R.h5; python -m analysis.tracking.python_call R.h5`
"""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np

import lightpage
from lightpage.errors import LightpageError
from lightpage.recording.reader import Recording


@click.command()
@click.argument("recording", type=click.Path(path_type=Path))
@click.option("--bundle", default="bench", show_default=True, help="A bundle's path, or the name of a shipped one.")
@click.option(
    "--page", "pages", multiple=True, default=(0, 10, 20, 29), type=int, help="Page, in the order of the call."
)
@click.option("--tracking/--no-tracking", default=True, help="Follow the image.")
def main(recording: Path, bundle: str, pages: tuple[int, ...], tracking: bool) -> None:
    """Decode pages of RECORDING by the Python call, and compare them with what was written."""
    decoder = lightpage.load(bundle, tracking=tracking)
    data = ~decoder.bundle.pilot_mask
    with Recording.open(recording) as file:
        for page in pages:
            symbols = file.symbols(page)
            assert symbols is not None, "the recording tells no symbols"
            try:
                read = decoder.decode(file.frames(page), file.levels)
            except LightpageError as error:
                click.echo(f"page {page}: {error}")
                continue
            click.echo(f"page {page}: {np.mean((read.symbols != symbols)[data]):.3f} wrong")


if __name__ == "__main__":
    main()
