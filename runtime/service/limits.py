"""The limits of the service, each with its reason."""

from __future__ import annotations

from dataclasses import dataclass

from runtime.wire.sizes import CHUNK_BYTES, MESSAGE_BYTES, REPLY_BYTES

PAIR_BYTES = 256 << 20
"""Both frames of a pair: three times a full-scale 20-megapixel pair of 16 bits."""

CONCURRENT_RECEIVES = 8
"""Frame pairs being received, each with its buffer: bounds memory, leaves room for slow senders."""

CONCURRENT_DECODES = 2
"""Decodes at once: inference uses all cores, a second page fills the gaps around it, a third would only wait inside."""

CONCURRENT_CALLS = 48
"""Calls that hold a thread; beyond them the service answers RESOURCE_EXHAUSTED at once instead of queueing blindly."""

WORKER_THREADS = 24
"""Threads for calls: receives, decodes, a recalibration and small calls beside them."""

RECEIVE_S = 30.0
"""A client that has not sent its frames by then has stalled, and its buffer is given back."""

DEADLINE_S = 60.0
"""Wait for a free slot where the caller set no deadline of its own."""

RECALIBRATION_PAGES = 16
"""Pages that one recalibration reads into memory."""

RECALIBRATION_S = 300.0
"""One recalibration in its own process. On two cores a bench device's takes 8 s beside an idle service, and 90 s beside
reads without a pause on both cores, since its priority leaves it what they do not use and a tenth of a core."""

CONCURRENT_RANGES = 4
"""Ranges of pages being read for their bytes: each holds a thread for as long as its caller takes."""

RANGE_PAGES = 4096
"""Pages of one range."""

RANGE_S = 3600.0
"""A range that is not read to its end by then is dropped, with a caller that does not take it."""

CONCURRENT_WATCHES = 2
"""Controllers that watch what is to be shown, each holding a thread: one, and one whose connection has been lost."""

GRACE_S = 10.0
"""Time that calls in flight get when the service is told to stop."""


@dataclass(frozen=True)
class Limits:
    """The limits that one service runs under."""

    message_bytes: int = MESSAGE_BYTES
    chunk_bytes: int = CHUNK_BYTES
    pair_bytes: int = PAIR_BYTES
    reply_bytes: int = REPLY_BYTES
    concurrent_receives: int = CONCURRENT_RECEIVES
    concurrent_decodes: int = CONCURRENT_DECODES
    concurrent_calls: int = CONCURRENT_CALLS
    worker_threads: int = WORKER_THREADS
    receive_s: float = RECEIVE_S
    deadline_s: float = DEADLINE_S
    recalibration_pages: int = RECALIBRATION_PAGES
    recalibration_s: float = RECALIBRATION_S
    concurrent_ranges: int = CONCURRENT_RANGES
    range_pages: int = RANGE_PAGES
    range_s: float = RANGE_S
    concurrent_watches: int = CONCURRENT_WATCHES
    grace_s: float = GRACE_S
