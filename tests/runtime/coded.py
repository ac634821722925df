"""Files on the toy device: a bundle with a code, pages that show a file, and recordings of them."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np

from lightpage.codec.code import Code
from lightpage.errors import PageError
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.pages import Pages
from lightpage.recording.writer import RecordingWriter
from lightpage.runtime.commands.archives.encode import encode
from lightpage.runtime.device.acquisition.source import SHOT_S, FrameSource, Shot
from tests.lightpage.command import run
from tests.runtime import toy

CODE = Code(levels=32, coded_bits=2, rate_per_mille=500, corrections=1, needed_information=0.6)
CONTENT = np.random.default_rng(5).bytes(1000)


def bundle(path: Path, code: Code | None = CODE) -> Path:
    """A toy bundle with a code."""
    return toy.write_toy_bundle(path, code=None if code is None else code.to_toml())


def pages(bundle_path: Path, folder: Path, content: bytes = CONTENT, *options: str) -> np.ndarray:
    """The symbols of a file's pages in groups of 3 + 2, written to folder / pages.h5."""
    (folder / "sent.bin").write_bytes(content)
    options = options or ("--data-pages", "3", "--parity-pages", "2", "--volume", "9")
    run(encode, folder / "sent.bin", "--bundle", bundle_path, "--out", folder / "pages.h5", *options)
    with Pages.open(folder / "pages.h5") as written:
        return np.stack(list(written))


Spoil = Callable[[FramePair], FramePair]


def dark(pair: FramePair) -> FramePair:
    """A page that was written nowhere: the reference beam alone, with its noise."""
    rng = np.random.default_rng(3)
    frames = [offset + 12 * rng.standard_normal(toy.SHAPE) for offset in toy.OFFSETS]
    return FramePair(*(np.clip(np.rint(frame), 0, 254).astype(np.uint8) for frame in frames))


def half_lost(pair: FramePair) -> FramePair:
    """A page on whose left half another page was written, pilots and all."""
    other = toy.ToyDevice(seed=8).page(toy.symbols_of(CODE.levels, 8)[0], CODE.levels)
    frames = [frame.copy() for frame in (pair.in_phase, pair.quadrature)]
    for frame, wrong in zip(frames, (other.in_phase, other.quadrature), strict=True):
        frame[:, : toy.SHAPE[1] // 2] = wrong[:, : toy.SHAPE[1] // 2]
    return FramePair(*frames)


def recording(
    path: Path,
    symbols: Sequence[np.ndarray] | np.ndarray,
    spoilt: dict[int, Spoil] | None = None,
    levels: int = CODE.levels,
    known: bool = True,
    code: str | None = None,
) -> Path:
    """A recording of pages, some of them spoilt, whose symbols it tells or not."""
    device = toy.ToyDevice(noise=8.0)
    with RecordingWriter(path, toy.PROFILE, levels, 8, device.references(), code=code) as writer:
        for index, page in enumerate(symbols):
            pair = device.page(page, CODE.levels, 0.1 * index)
            pair = (spoilt or {}).get(index, lambda same: same)(pair)
            writer.append(page if known else None, pair)
    return path


class ShownPages(FrameSource):
    """A source that shows pages, some of them spoilt; it does not know what was written."""

    name, bit_depth, levels, frame_shape = "toy:pages", 8, CODE.levels, toy.SHAPE

    def __init__(self, symbols: Iterable[np.ndarray], spoilt: dict[int, Spoil] | None = None) -> None:
        self._symbols, self._spoilt = list(symbols), spoilt or {}
        self.device = toy.ToyDevice(noise=8.0)

    def shot(self, timeout_s: float = SHOT_S, page: int | None = None) -> Shot:
        number = page or 0
        if number >= len(self._symbols):
            raise PageError("page of toy:pages", number, f"0..{len(self._symbols) - 1}")
        pair = self.device.page(self._symbols[number], CODE.levels, 0.1)
        return Shot(self._spoilt.get(number, lambda same: same)(pair), number)

    def references(self) -> FramePair:
        return self.device.references()
