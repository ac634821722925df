"""The limits of the service, each with its reason."""

from collections.abc import Iterator
from typing import Annotated

from pydantic import Field

from lightpage.runtime.client.wire.messages import CHUNK_BYTES, MESSAGE_BYTES, REPLY_BYTES
from lightpage.runtime.device.acquisition.page_store import UPLOADED_BYTES
from lightpage.runtime.service.table import Rule, SettingsTable

JOBS_KEPT = 64
"""Results of jobs that are kept."""

GRACE_S = 10.0
"""Time that calls in flight get when the service is told to stop."""

_HEADER_BYTES = 1 << 10
"""Of a message beside the chunk in it, at most."""

_Bytes = Annotated[int, Field(ge=1, le=(1 << 31) - 1)]
"""Of a message: gRPC counts them in 32 bits."""
_MemoryBytes = Annotated[int, Field(ge=1, le=1 << 40)]
_DAY = Field(gt=0, le=86_400, allow_inf_nan=False)
_Seconds = Annotated[float, _DAY]
_Count = Annotated[int, Field(ge=1, le=4096)]


class Limits(SettingsTable):
    """The limits that one service runs under: the table [limits] of its settings.

    Each default has its reason below it, or where it is named. A connection has no longest age unless one is set: a
    device's only controller would gain nothing by a new one, and lose its session. Nor are calls ended for it.
    """

    message_bytes: _Bytes = MESSAGE_BYTES
    """One message to the service, except of `ModelInfer`, which takes a pair in one."""
    chunk_bytes: _Bytes = CHUNK_BYTES
    """One chunk of frames. The Python client sends chunks of 1 MiB, which a smaller limit refuses."""
    pair_bytes: _MemoryBytes = 256 << 20
    """Both frames of a pair: three times a full-scale 20-megapixel pair of 16 bits."""
    reply_bytes: _Bytes = REPLY_BYTES
    """One reply. The Python client takes none of more than 64 MiB."""
    receive_bytes: _MemoryBytes = 1 << 30
    """Bytes of pairs that were received and are not yet decoded, of all callers together: bounds the memory."""
    concurrent_decodes: Annotated[int, Field(ge=1, le=256)] = 2
    """Decodes at once: inference uses all cores, a second page fills the gaps around it, a third would only wait
    inside."""
    concurrent_calls: _Count = 192
    """Calls at once; beyond them the service refuses at once. A call that waits for its turn holds a thread, and one
    that sends its frames does not."""
    receive_s: _Seconds = 30.0
    """Time to send a frame pair, or pages to upload. A slower client's buffer is given back."""
    stall_s: _Seconds = 5.0
    """Longest pause of a client in the middle of its frames; then it has stalled."""
    shared_bytes: _MemoryBytes = 1 << 30
    """Memory shared with clients, all of it together: a dozen full-size pairs of 16 bits."""
    shared_regions: _Count = 64
    """Regions of shared memory at once."""
    replay_s: _Seconds = 600.0
    """Time for which an answer with a request id is kept: a controller that lost its connection has time to come
    back."""
    replay_bytes: _MemoryBytes = 64 << 20
    """All answers that are kept for request ids: some 300 full-size pages of symbols and confidences."""
    model_bytes: _MemoryBytes = 1 << 30
    """An uploaded bundle: five times a full-size one."""
    model_s: _Seconds = 600.0
    """Time to send a bundle: a full-size one comes over a slow line in that time."""
    jobs_kept: Annotated[int, Field(ge=1, le=1_000_000)] = JOBS_KEPT
    """Results of jobs; the oldest are forgotten."""
    decode_s: _Seconds = 120.0
    """Time after which a decode has hung, and health checks fail: three times a full-size page by waves on two
    cores."""
    deadline_s: _Seconds = 60.0
    """Wait for a free slot if the caller set no deadline of its own."""
    recalibration_pages: _Count = 16
    """Pages that one recalibration reads into memory."""
    kept_bytes: _MemoryBytes = 512 << 20
    """Frames of the last pages that a service keeps to recalibrate itself by: eight full-size pairs of 16 bits."""
    recalibration_s: _Seconds = 900.0
    """Time of one recalibration in its own process. On two cores a bench device's takes 16 s beside an idle service,
    and 95 s beside reads without a pause on both cores, since its priority leaves it what they do not use and a tenth
    of a core. One that heals takes up to four times as long."""
    uploaded_bytes: _MemoryBytes = UPLOADED_BYTES
    """Uploaded pages, which lie in memory until the service ends."""
    concurrent_ranges: _Count = 4
    """Ranges of pages of which a page is being read. A range whose caller takes its time to read a reply does not
    count."""
    range_pages: Annotated[int, Field(ge=1, le=1 << 32)] = 4096
    """Pages of one range."""
    range_s: _Seconds = 3600.0
    """Time to read a range to its end; then it is dropped."""
    reader_s: _Seconds = 60.0
    """Time for a caller to take a reply of a stream. Then it has stalled, and its call is ended: until then the reply
    and what was read ahead for it lie in memory."""
    concurrent_watches: _Count = 2
    """Controllers that watch what is to be shown: one, and one whose connection has been lost."""
    grace_s: Annotated[float, Field(ge=0, le=3600, allow_inf_nan=False)] = GRACE_S
    """Time for calls in progress when the service is told to stop; then they are ended."""
    connection_age_s: Annotated[float | None, _DAY] = None
    """Age at which a connection is closed, give or take a tenth, so that callers behind a balancer connect anew. Calls
    on it end first, and its session ends with it."""
    connection_grace_s: Annotated[float | None, _DAY] = None
    """Time for the calls that are still on a connection of that age; without it they are never cut off."""

    def rules(self) -> Iterator[Rule]:
        """Yield the rules among limits."""
        most = self.message_bytes - _HEADER_BYTES
        wanted = f"at least {_HEADER_BYTES} less than limits.message_bytes, which is {self.message_bytes}"
        yield self.chunk_bytes <= most, "chunk_bytes", wanted
        wanted = f"at least limits.pair_bytes, which is {self.pair_bytes}: a larger pair would never be taken"
        yield self.receive_bytes >= self.pair_bytes, "receive_bytes", wanted
        yield self.stall_s <= self.receive_s, "stall_s", f"at most limits.receive_s, which is {self.receive_s:g}"
        alone = self.connection_grace_s is not None and self.connection_age_s is None
        yield not alone, "connection_grace_s", "limits.connection_age_s too: the age after which it begins"
