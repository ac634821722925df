"""Decodes a recording page by page, for who calls it from Python."""

from collections.abc import Iterator

from lightpage.errors import InvalidInputError, LostPageError, StorageError
from lightpage.page.pilots import Pilots
from lightpage.recording.layout import narrow
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.evaluation import check_recording, pilots_of
from lightpage.runtime.archives.recordings.read_ahead import read_ahead
from lightpage.runtime.archives.recordings.refused import RefusedPage
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.following import FollowingDecoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.runtime.model.decoding.page import DecodedPage


def decode_recording(decoder: Decoder, recording: Recording) -> Iterator[DecodedPage | RefusedPage]:
    """Decode all pages in their order, the image followed from page to page, by the recording's own pilots.

    Args:
        decoder: a bundle's, e.g. of `lightpage.load`.
        recording: recording of its kind of device.

    Yields:
        Each page, or why it is not given out: it cannot be decoded, or its pilots contradict what was decoded.

    Raises:
        RecordingError: other shapes or another bit depth.
    """
    check_recording(decoder, recording)
    tracker = decoder.tracker if isinstance(decoder, FollowingDecoder) else tracker_for(decoder)
    mask, levels = pilots_of(decoder, recording), recording.levels
    for number, read in read_ahead(recording.shown, range(recording.pages)):
        try:
            frames, symbols = read.result()
            known = None if symbols is None else Pilots.of_symbols(mask, symbols, decoder.bundle.levels(levels))
            pilots = decoder.pilots(levels, mask) if known is None else known
            yield tracker.decode(narrow(frames, recording.bit_depth), levels, pilots)
        except (InvalidInputError, LostPageError, StorageError) as error:
            yield RefusedPage.of(number, error)
