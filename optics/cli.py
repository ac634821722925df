"""`lightpage simulate`: record pages of a simulated device, page by page, so that an interruption loses nothing."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np
from tqdm import tqdm

from optics.device import Device, load_device
from optics.errors import InvalidInputError
from optics.page import MAX_LEVELS, MIN_LEVELS, random_symbols
from optics.profile import Profile, load_profile, to_toml
from optics.recording import RecordingWriter
from optics.recording_writer import discard_partial, partial_path
from optics.simulator import Simulator

_SYMBOLS = 3
"""Random stream of the pages' symbols, beside those of the simulator."""


@click.command()
@click.option("--profile", "profile_name", required=True, metavar="P", help="Nominal device: a shipped name or a file.")
@click.option("--pages", required=True, type=click.IntRange(min=1), help="How many pages.")
@click.option("--out", required=True, type=click.Path(path_type=Path), help="The recording, R.h5.")
@click.option("--levels", default=MAX_LEVELS, show_default=True, type=click.IntRange(MIN_LEVELS, MAX_LEVELS))
@click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0), help="Of symbols, noise and drift.")
@click.option("--device", "device_file", type=click.Path(), help="True state of the device, TOML; realistic if absent.")
@click.option("--set", "settings", multiple=True, metavar="TABLE.KEY=VALUE", help="Change one number of that state.")
@click.option("--truth/--no-truth", default=True, help="Keep what only a simulator knows beside the pages.")
@click.option("--force", is_flag=True, help="Overwrite a recording that exists, or pages begun with other settings.")
def simulate(
    profile_name: str,
    pages: int,
    out: Path,
    levels: int,
    seed: int,
    device_file: str | None,
    settings: tuple[str, ...],
    truth: bool,
    force: bool,
) -> None:
    """Record pages of a simulated device.

    Interrupted, the same command goes on where it stopped, and the recording is the same as without interruption.
    """
    profile = load_profile(profile_name)
    device = (load_device(device_file) if device_file else Device()).with_settings(list(settings))
    if out.exists() and not force:
        raise InvalidInputError(f"--out {out}", "a file that exists", "a new name, or --force")
    job = _Job(profile, device, levels, seed, truth, out)
    job.claim(force)
    job.run(pages)


class _Job:
    """One recording to make. Beside the partial file lie the settings that it is made with, until it is complete."""

    def __init__(self, profile: Profile, device: Device, levels: int, seed: int, truth: bool, out: Path) -> None:
        self.profile, self.device, self.levels, self.seed, self.truth = profile, device, levels, seed, truth
        self.out = out
        self._simulator = Simulator(profile, device, levels, seed)
        self.partial = partial_path(out)
        self.settings = out.with_name(out.name + ".partial.toml")

    def claim(self, force: bool) -> None:
        """Note the settings, unless pages begun with others are there.

        Raises:
            InvalidInputError: they are there and `force` is not given, they are being written, or the folder cannot be.
        """
        # references alone would not tell two devices apart: the pipe does not show in them
        text = f"levels = {self.levels}\nseed = {self.seed}\ntruth = {str(self.truth).lower()}\n"
        text += f"{to_toml(self.device)}\n# profile\n{self.profile.to_toml()}"
        try:
            begun = self.settings.read_text("utf-8") if self.settings.exists() else None
            if self.partial.exists() and begun != text:
                if not force:
                    raise InvalidInputError(
                        f"--out {self.out}",
                        f"pages begun with other settings ({self.partial.name})",
                        "the same settings, to go on with them, or --force, to start anew",
                    )
                discard_partial(self.out)
            self.settings.write_text(text, "utf-8")
        except OSError as error:
            raise InvalidInputError(f"--out {self.out}", error, "a place that can be written") from None

    def run(self, pages: int) -> None:
        """Simulate what is missing of `pages` pages, with a progress bar, and give the file its final name.

        Raises:
            InvalidInputError: more pages are there already.
            RecordingError: the file cannot be written.
        """
        simulator = self._simulator
        bits = self.device.sensor.bit_depth
        with RecordingWriter.resume(self.out, self.profile, self.levels, bits, simulator.references()) as writer:
            if writer.pages > pages:
                raise InvalidInputError("--pages", pages, f"at least the {writer.pages} pages that are there already")
            if self.truth:
                writer.set_truth(to_toml(self.device))
            simulator.skip(writer.pages)
            for page in tqdm(
                range(writer.pages, pages), initial=writer.pages, total=pages, unit="page", desc="simulate"
            ):
                self._append(writer, simulator, page)
        self.settings.unlink(missing_ok=True)

    def _append(self, writer: RecordingWriter, simulator: Simulator, page: int) -> None:
        rng = np.random.default_rng([self.seed, _SYMBOLS, page])
        symbols = random_symbols(self.profile, self.levels, 1, rng)[0]
        seen = simulator.simulate(symbols)
        truth = {
            "exit_field": np.asarray(seen.exit_field, dtype=np.complex64),
            "piston": np.array(seen.piston),
            "shift_px": np.array(seen.shift_px),
        }
        writer.append(symbols, seen.pair, truth if self.truth else None)
