"""A decode loop without anything around it: `python -m analysis.scaling.bare_loop RECORDING BUNDLE FIRST END THREADS`.

It prints how many seconds it took for its pages, the opening of the bundle not counted.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.evaluation import decode_unseen, pilots_of
from lightpage.runtime.archives.recordings.read_ahead import read_ahead
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for


def main(recording: Path, bundle: Path, first: int, end: int, threads: int) -> None:
    """Decode pages as an evaluation does, and keep nothing."""
    decoder = Decoder.load(bundle, threads)
    tracker = tracker_for(decoder)
    with Recording.open(recording) as file:
        mask = pilots_of(decoder, file)
        begun = time.perf_counter()
        for _, read in read_ahead(file.shown, range(first, end)):
            frames, symbols = read.result()
            decode_unseen(decoder, file, tracker, mask, frames, symbols)
    print(time.perf_counter() - begun)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), *map(int, sys.argv[3:6]))
