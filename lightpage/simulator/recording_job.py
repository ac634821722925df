"""A recording of a simulated device, made page by page, so that an interruption loses nothing."""

from __future__ import annotations

import math
import shutil
from hashlib import file_digest
from pathlib import Path

import numpy as np

from lightpage.device.profile import Profile, to_toml
from lightpage.device.state import Device
from lightpage.errors import InvalidInputError, NoRoomError, RecordingError
from lightpage.failures import os_errors
from lightpage.page.symbols import random_symbols
from lightpage.progress import track
from lightpage.recording.hdf5 import patiently
from lightpage.recording.layout import frame_type
from lightpage.recording.pages import Pages
from lightpage.recording.unfinished import claim, drop_claim, partial_path
from lightpage.recording.writer import RecordingWriter
from lightpage.simulator.engine import CPU, NUMPY, engine_on
from lightpage.simulator.simulator import LIGHT, Simulator
from lightpage.words import counted

SYMBOLS = 3
"""Random stream of the pages' symbols, beside those of the simulator."""


class RecordingJob:
    """Job that makes one recording. Its settings lie beside the partial file until the recording is complete.

    Args:
        profile: the nominal device.
        device: true state of the device.
        levels: M.
        seed: seed of symbols, noise and drift.
        truth: whether to keep what only a simulator knows beside the pages.
        out: the recording.
        written: pages that the modulator shows; random ones if left out.
        compute: where pages are computed, see `lightpage.simulator.engine.engine_on`.

    Raises:
        RecordingError: pages for another profile.
    """

    def __init__(
        self,
        profile: Profile,
        device: Device,
        levels: int,
        seed: int,
        truth: bool,
        out: Path,
        written: Pages | None = None,
        compute: str = CPU,
    ) -> None:
        self.profile, self.device, self.levels, self.seed, self.truth = profile, device, levels, seed, truth
        self.out, self._written = out, written
        if written is not None:
            written.check_against(profile)
        self._engine = engine_on(compute)
        self._simulator = Simulator(profile, device, levels, seed, engine=self._engine)

    def claim(self, force: bool) -> None:
        """Note the settings, unless pages begun with others are there.

        Raises:
            InvalidInputError: they are there and `force` is not given, they are being written, or the folder cannot be.
        """
        # references alone would not tell two devices apart: the pipe does not show in them
        text = f"light = {LIGHT}\nlevels = {self.levels}\nseed = {self.seed}\ntruth = {str(self.truth).lower()}\n"
        if self._engine is not NUMPY:
            text += f"noise = {type(self._engine).__name__}\n"  # of a stream of its own
        if self._written is not None:
            digest = patiently(self._digest, f"pages {self._written.path}", otherwise=RecordingError)
            text += f"symbols = {digest}\n"
        text += f"{to_toml(self.device)}\n# profile\n{self.profile.to_toml()}"
        claim(self.out, text, force=force)

    def _digest(self) -> str:
        assert self._written is not None  # or there is nothing to tell apart
        with self._written.path.open("rb") as file:
            return file_digest(file, "sha256").hexdigest()

    def run(self, pages: int) -> None:
        """Simulate what is missing of `pages` pages, with a progress bar, and give the file its final name.

        Raises:
            InvalidInputError: more pages are there already.
            RecordingError: the file cannot be written.
        """
        simulator = self._simulator
        bits = self.device.sensor.bit_depth
        code = None if self._written is None else self._written.code
        writer = RecordingWriter(
            self.out, self.profile, self.levels, bits, simulator.references(), resume=True, code=code
        )
        with writer:
            if writer.pages > pages:
                raise InvalidInputError("--pages", pages, f"at least the {writer.pages} pages that are there already")
            if self.truth:
                writer.add_note("truth", {"device": to_toml(self.device)})
            simulator.skip(writer.pages)
            for page in track(range(writer.pages, pages), "simulate", total=pages, done=writer.pages):
                self._append(writer, simulator, page)
        drop_claim(self.out)

    def check_room(self, pages: int) -> None:
        """Check that the frames of so many pages have room on the disk, but for those that are there already.

        Raises:
            NoRoomError: they have none.
        """
        frame = math.prod(self.profile.frame_shape) * frame_type(self.device.sensor.bit_depth).itemsize
        partial = partial_path(self.out)
        with os_errors(f"--out {self.out}", "a folder"):
            there = partial.stat().st_size if partial.exists() else 0
            try:
                free = shutil.disk_usage(self.out.absolute().parent).free
            except AttributeError:  # a system without the call
                return
        if (needed := 2 * frame * pages - there) > free:
            told = counted(pages, "page")
            raise NoRoomError(f"--out {self.out}", f"{free / 1e9:.3g} GB free", f"{needed / 1e9:.3g} GB for {told}")

    def _append(self, writer: RecordingWriter, simulator: Simulator, page: int) -> None:
        if self._written is None:
            rng = np.random.default_rng([self.seed, SYMBOLS, page])
            symbols = random_symbols(self.profile, self.levels, 1, rng)[0]
        else:
            symbols = self._written[page]
        seen = simulator.simulate(symbols)
        truth = {
            "exit_field": np.asarray(seen.exit_field, dtype=np.complex64),
            "piston": np.array(seen.piston),
            "shift_px": np.array(seen.shift_px),
        }
        writer.append(symbols, seen.pair, truth if self.truth else None)
