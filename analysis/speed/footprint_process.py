"""Loads a bundle, decodes its golden page some times, and tells what that took: a process of its own, without torch.

`analysis.speed.footprint` starts it with a bundle, a number of pages and one of threads.
"""

from __future__ import annotations

import json
import re
import resource
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from lightpage.runtime.model.decoding.decoder import Decoder

_LEVELS = 16


@dataclass(frozen=True)
class Taken:
    """Time and memory that a process took.

    Attributes:
        load_s: seconds from the path to a decoder that has proven its golden page.
        pages_s: seconds of each page.
        peak_bytes: most memory that the process held, its programs included.
    """

    load_s: float
    pages_s: tuple[float, ...]
    peak_bytes: int


def peak_bytes() -> int:
    """Return the peak memory of this process, bytes.

    Linux hands `ru_maxrss` on to a process that another one starts, with the other's peak; its own is told beside it.
    """
    try:
        found = re.search(r"^VmHWM:\s*(\d+) kB$", Path("/proc/self/status").read_text(), re.MULTILINE)
    except OSError:
        found = None
    kib = int(found[1]) if found else resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return 1024 * kib


def taken(bundle: Path, pages: int, threads: int) -> Taken:
    """Load and decode in this process.

    Args:
        bundle: path of the bundle.
        pages: how often the golden page is decoded, may be 0.
        threads: threads of one decode.

    Raises:
        BundleError: no bundle that decodes.
    """
    start = time.perf_counter()
    decoder = Decoder.load(bundle, threads)
    load_s, pages_s = time.perf_counter() - start, []
    for _ in range(pages):
        start = time.perf_counter()
        decoder.decode(decoder.bundle.golden.pair, _LEVELS)
        pages_s.append(time.perf_counter() - start)
    return Taken(load_s, tuple(pages_s), peak_bytes())


if __name__ == "__main__":
    print(json.dumps(asdict(taken(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])))))
