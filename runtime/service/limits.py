"""The limits of the service, each with its reason."""

from __future__ import annotations

from dataclasses import dataclass

from runtime.wire.sizes import CHUNK_BYTES, MESSAGE_BYTES, REPLY_BYTES

PAIR_BYTES = 256 << 20
"""Both frames of a pair: three times a full-scale 20-megapixel pair of 16 bits."""

RECEIVE_BYTES = 1 << 30
"""Bytes of pairs that were received and are not yet decoded, of all callers together: bounds the memory."""

CONCURRENT_DECODES = 2
"""Decodes at once: inference uses all cores, a second page fills the gaps around it, a third would only wait inside."""

CONCURRENT_CALLS = 192
"""Calls at once; beyond them the service refuses at once. A call that waits for its turn holds a thread, and one that
sends its frames does not."""

RECEIVE_S = 30.0
"""A client that has not sent its frames by then is too slow, and its buffer is given back."""

STALL_S = 5.0
"""A client that sends nothing for so long in the middle of its frames has stalled."""

REPLAY_S = 600.0
"""An answer with a request id is kept for so long: a controller that lost its connection has time to come back."""

REPLAY_BYTES = 64 << 20
"""All such answers together: some 300 full-size pages of symbols and confidences."""

MODEL_BYTES = 1 << 30
"""An uploaded bundle: five times a full-size one."""

MODEL_S = 600.0
"""A bundle that has not come by then is dropped: a full-size one comes over a slow line in that time."""

JOBS_KEPT = 64
"""Results of jobs that are kept."""

DECODE_S = 120.0
"""A decode that takes longer has hung, and health checks fail: three times a full-size page by waves on two cores."""

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
    receive_bytes: int = RECEIVE_BYTES
    concurrent_decodes: int = CONCURRENT_DECODES
    concurrent_calls: int = CONCURRENT_CALLS
    receive_s: float = RECEIVE_S
    stall_s: float = STALL_S
    replay_s: float = REPLAY_S
    replay_bytes: int = REPLAY_BYTES
    model_bytes: int = MODEL_BYTES
    model_s: float = MODEL_S
    jobs_kept: int = JOBS_KEPT
    decode_s: float = DECODE_S
    deadline_s: float = DEADLINE_S
    recalibration_pages: int = RECALIBRATION_PAGES
    recalibration_s: float = RECALIBRATION_S
    concurrent_ranges: int = CONCURRENT_RANGES
    range_pages: int = RANGE_PAGES
    range_s: float = RANGE_S
    concurrent_watches: int = CONCURRENT_WATCHES
    grace_s: float = GRACE_S
