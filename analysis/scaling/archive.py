"""Archives to measure on: bench pages, of which some are simulated and the others are these with new noise."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from lightpage.device.profile import load_profile
from lightpage.device.state import Device
from lightpage.page.symbols import random_symbols
from lightpage.progress import track
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.reader import Recording, RecordingWriter
from lightpage.simulator.simulator import Simulator
from runtime.bundle.bundle import Bundle
from runtime.scaling.job import Choices, Job, bundle_sha256, look_at
from runtime.scaling.ledger import Ledger
from runtime.scaling.shard import ShardRecord
from runtime.scaling.task import NamedBundle, Operation

LEVELS = 16
_NOISE_COUNTS = 2.0
"""Standard deviation of the noise that tells two pages of one field apart, counts."""


def archive(folder: Path, pages: int, fields: int, seed: int) -> Path:
    """A recording of the shipped bundle's device with known symbols; made once.

    Args:
        folder: where it goes.
        pages: that it has.
        fields: how many of them are simulated.
        seed: of symbols and noise.
    """
    simulated, out = folder / "fields.h5", folder / "archive.h5"
    profile, device = load_profile("bench"), Device()
    bits = device.sensor.bit_depth
    if not simulated.exists():
        simulator = Simulator(profile, device, LEVELS, seed)
        symbols = random_symbols(profile, LEVELS, fields, np.random.default_rng(seed))
        with RecordingWriter.resume(simulated, profile, LEVELS, bits, simulator.references()) as writer:
            for number in track(range(writer.pages, fields), "simulate", total=fields, done=writer.pages):
                writer.append(symbols[number], simulator.page(symbols[number]))
    if not out.exists():
        rng = np.random.default_rng(seed)
        with (
            Recording.open(simulated) as known,
            RecordingWriter(out, profile, LEVELS, bits, known.references()) as writer,
        ):
            for number in track(range(pages), "new noise", total=pages):
                pair, written = known.shown(number % fields)
                writer.append(written, _noisy(pair, bits, rng))
    return out


def _noisy(pair: FramePair, bits: int, rng: np.random.Generator) -> FramePair:
    frames = []
    for frame in (pair.in_phase, pair.quadrature):
        counts = frame + rng.normal(0.0, _NOISE_COUNTS, frame.shape)
        frames.append(np.clip(np.rint(counts), 0, 2**bits - 1).astype(frame.dtype))
    return FramePair(*frames)


def finished_ledger(folder: Path, like: ShardRecord, pages: int, bundle: Path) -> None:
    """A run over so many pages that is finished, without their having been read.

    Args:
        folder: of the run; the recording lies in it, its frames without bytes on the disk.
        like: a shard of as many pages as a range has; all are copies of it.
        pages: of the whole run.
        bundle: that the run says it has used.
    """
    folder.mkdir(parents=True, exist_ok=True)
    shape = Bundle.open(bundle).profile.frame_shape
    with h5py.File(str(folder / "empty.h5"), "w") as file:
        file.attrs.update({"format": "lightpage-recording", "version": 1, "camera_bit_depth": 8, "levels": LEVELS})
        for name in ("in_phase", "quadrature"):
            file.create_dataset(name, (pages, *shape), np.uint8, chunks=(1, *shape))
            file.create_dataset(f"reference_{name}", shape, np.uint8)
    size = len(like.pages)
    choices = Choices(operation=Operation.EVALUATE, range_pages=size)
    model = NamedBundle(path=bundle, sha256=bundle_sha256(bundle), version=like.model.version)
    job = Job(choices=choices, bundles=(model,), sources=(look_at("", folder / "empty.h5", 0),))
    with Ledger(folder / "run") as ledger:
        job.write(ledger.folder)
        for task in ledger.missing(job):
            numbered = zip(like.pages, task.pages, strict=False)
            own = tuple(page.model_copy(update={"page": number}) for page, number in numbered)
            like.model_copy(update={"pages": own}).write(task.shard)
