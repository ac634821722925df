"""Pages that were read, as known ones: their bytes, encoded again, are the symbols that were written."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lightpage.codec.code import Code
from lightpage.codec.page_bytes import PageBytes
from lightpage.codec.volume import Volume
from lightpage.errors import RecordingError
from lightpage.progress import track, warn
from lightpage.recording.joined import show_known
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.page_reader import PageReader
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.temporary import temporary_folder


class ReadPages:
    """Symbols of the pages of a recording that give their bytes.

    Args:
        recording: recording of the pages.
        decoder: decoder of their device.
        code: code of the pages.

    Attributes:
        symbols: uint8 [ny, nx], by the page's number in the recording.
    """

    def __init__(self, recording: Recording, decoder: Decoder, code: Code) -> None:
        self._recording, self._code = recording, code
        self._codec = decoder.codec_of(code)
        self._pilots = decoder.bundle.written_pilots(code.levels)
        self.symbols: dict[int, NDArray[np.uint8]] = {}

    def add(self, index: int, found: PageBytes) -> None:
        """Take note of a page, by what it gave; one that is lost tells no symbols."""
        if found.loss is None:
            self.symbols[index] = self._codec.encode_again(found, self._pilots)

    def write(self, out: Path) -> None:
        """Write them and their frames as a recording; see `lightpage.recording.joined.show_known`.

        Raises:
            RecordingError: there are none, or the file cannot be written.
        """
        if not self.symbols:
            got = f"{self._recording.pages} pages of which none gave its bytes"
            expected = "known symbols, or pages that bundle and code read"
            raise RecordingError(f"recording {self._recording.path}", got, expected)
        show_known(self._recording.path, self.symbols, self._code.levels, out)


def write_read_pages(decoder: Decoder, recording: Recording, code: Code, out: Path, most: int | None = None) -> None:
    """Read pages of user data, healing the model where need be, and write those that were read as known ones.

    Args:
        decoder: decoder of the device.
        recording: recording of the pages.
        code: code of the pages.
        out: the new recording.
        most: pages that are enough; None for all.

    Raises:
        RecordingError: another device's recording, or one of other levels or pilots, or see `ReadPages.write`.
    """
    read = ReadPages(recording, decoder, code)

    def take(index: int, found: PageBytes) -> Volume | None:
        read.add(index, found)
        return Volume.of_page(found)

    lost = 0
    pages = PageReader(decoder, recording, tracker_for(decoder), code).read(range(recording.pages), take)
    for page in track(pages, "read", total=recording.pages):
        lost += page.loss is not None
        if most is not None and len(read.symbols) >= most:
            break
    if lost:
        warn(f"recording {recording.path}: {lost} pages gave no bytes: what is found holds for the others")
    read.write(out)


@contextmanager
def known_pages_of(decoder: Decoder, recording: Recording, code: Callable[[], Code]) -> Iterator[Recording]:
    """The recording itself where it has symbols, or else its pages that were read.

    Args:
        decoder, recording: as for `write_read_pages`.
        code: gives that of the pages.

    Raises:
        LightpageError: as `write_read_pages` and `code` raise.
    """
    if recording.has_symbols:
        yield recording
        return
    with temporary_folder("symbols of pages that were read") as folder:
        write_read_pages(decoder, recording, code(), out := Path(folder) / "known.h5")
        with Recording.open(out) as known:
            known.path = recording.path  # which errors name
            yield known
