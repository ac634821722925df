"""A worker that fits the toy device: `... toy_worker FOLDER`."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from lightpage.progress import Progress
from runtime.bundle.bundle import Bundle
from runtime.decoding.decoder import Decoder
from runtime.recalibration.known_pages import KnownPages
from runtime.recalibration.outcome import RefitResult
from runtime.recalibration.work import WorkFolder
from runtime.recalibration.worker import end_with_parent, work, yield_to_reads
from tests.runtime import toy


def fit(bundle: Bundle, pages: KnownPages, progress: Progress, decoder: Decoder) -> RefitResult:
    progress(f"fit in {os.getpid()} at {os.nice(0)}", 0.5)
    return toy.fit_references(bundle, pages, progress, decoder)


if __name__ == "__main__":
    end_with_parent(sys.stdin.fileno())
    yield_to_reads()
    work(WorkFolder(Path(sys.argv[1])), fit)
