"""A Python client of the service; its errors are of the same classes that the service raised."""

from __future__ import annotations

import hashlib
import os
import secrets
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self, Unpack

import grpc
import numpy as np
from numpy.typing import NDArray

from lightpage.clock import SYSTEM, Clock
from lightpage.errors import FrameError, InvalidInputError, LightpageError
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.client import answers
from lightpage.runtime.client.answers import (
    Description,
    DisplayOrder,
    JobInfo,
    ModelInfo,
    Recalibrated,
    RemoteData,
    RemotePage,
)
from lightpage.runtime.client.outgoing import (
    KnownPilots,
    PageOptions,
    options_message,
    pair_parts,
    pilots_message,
    recalibration_pages,
    sent_frames,
    sent_symbols,
)
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2_grpc as pb_grpc
from lightpage.runtime.client.shared_memory import SharedMemory
from lightpage.runtime.client.wire.address import check_address
from lightpage.runtime.client.wire.channel import TlsFiles, open_channel
from lightpage.runtime.client.wire.messages import (
    CHUNK_BYTES,
    PIXEL_CODES,
    FramePart,
    chunks_of,
    message_of,
    serialized_part,
    set_fields,
)
from lightpage.runtime.client.wire.status import error_from, error_of, is_lost_connection
from lightpage.runtime.model.bundle.signature_file import read_signature

CALL_S = 60.0
"""Deadline of a call where none is given."""

DATA_S = 600.0
"""Deadline of a range of pages where none is given."""

RECALIBRATION_S = 600.0
"""Deadline of a recalibration where none is given."""


UPLOAD_S = 600.0
"""Deadline of an uploaded model where none is given."""

_WATCH_S = 60.0
"""A watch that hears nothing for so long begins anew: a network that swallows everything tells nobody."""

_AGAIN_S = 0.5
"""From a lost connection to the next try."""


class LightpageClient:
    """Talks to the service at `target` (HOST:PORT). Use it in a `with` statement, or `close` it.

    Every method raises the `LightpageError` that the service raised, or one that says why there was no answer.

    At a Unix socket (``unix:PATH``) the service cannot tell connections apart. There, each client names a session of
    its own for the frames that it sends, unless the caller names one.

    Args:
        target: where the service is.
        timeout_s: deadline of a call.
        tls: certificates to connect with; None for a service without TLS.
        clock: by which a watch of a job ends, and waits for a service that is away.

    Raises:
        InvalidInputError: no address, or certificates that are no good.
    """

    def __init__(
        self, target: str, timeout_s: float = CALL_S, tls: TlsFiles | None = None, clock: Clock = SYSTEM
    ) -> None:
        check_address("target", target)
        self.target, self._timeout, self._clock = target, timeout_s, clock
        self._session = f"client {secrets.token_hex(16)}" if target.startswith("unix:") else ""
        self._channel = open_channel(target, tls)
        self._stub = pb_grpc.LightpageStub(self._channel)  # type: ignore[no-untyped-call]
        # Not the stub's: their chunks are no messages.
        method = f"/{pb.DESCRIPTOR.services_by_name['Lightpage'].full_name}/"
        self._decode_frames = self._channel.stream_unary(
            f"{method}DecodeFrames", serialized_part, pb.DecodeReply.FromString
        )
        self._decode_shared = self._channel.unary_unary(  # one message, for which no thread has to send a stream
            f"{method}DecodeFrames", pb.DecodeFramesRequest.SerializeToString, pb.DecodeReply.FromString
        )
        self._decode_pages = self._channel.stream_stream(
            f"{method}DecodePages", serialized_part, pb.DecodePagesReply.FromString
        )
        self._description: Description | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End all calls and close the connection."""
        self._channel.close()

    def describe(self) -> Description:
        """What the service is now.

        Raises:
            LightpageError: no answer.
        """
        reply: pb.DescribeReply = self._unary(self._stub.Describe, pb.DescribeRequest())
        self._description = answers.description(reply)
        return self._description

    def decode(
        self,
        pair: FramePair,
        levels: int = 0,
        *,
        bit_depth: int | None = None,
        black_level: int = 0,
        pilots: KnownPilots | None = None,
        frame_id: int = 0,
        captured_s: float = 0.0,
        correlation_id: str = "",
        memory: SharedMemory | None = None,
        **options: Unpack[PageOptions],
    ) -> RemotePage:
        """Send a frame pair and get its symbols.

        Args:
            pair: both frames, uint8 or uint16.
            levels: M, 2..256; 0 for the default of the service, `Description.default_levels`, or that of the model's
                code where user bytes are asked for.
            bit_depth: bits of a camera count; by default those of the service's camera.
            black_level: counts that the cameras add to every pixel.
            pilots: known symbols, where they differ from the device's pilots.
            frame_id, captured_s, correlation_id: the caller's own; the page has them too, and the log the last one.
            memory: where the pair goes in place of being sent; it may be there already, as `SharedMemory.frames`.
            options: what to get, and whose pages the page is followed with; see `PageOptions`.

        Raises:
            FrameError: frames that cannot be sent, or that the service refuses.
            PageError: an impossible level count, or pilots that do not fit the page.
            SlotsTakenError: the service had no free slot until the deadline.
        """
        header = self._header(pair, levels, bit_depth, black_level, pilots, correlation_id, options)
        set_fields(header, frame_id=frame_id, captured_s=captured_s)
        if memory is not None:
            header.shared.offset = memory.write(pair)
            header.shared.region = memory.handle
            request = pb.DecodeFramesRequest(header=header)
            return answers.remote_page(self._unary(self._decode_shared, request))
        reply: pb.DecodeReply = self._unary(self._decode_frames, pair_parts(header, sent_frames(pair)))
        return answers.remote_page(reply)

    def share_memory(self, size: int = 0) -> SharedMemory:
        """Memory that is shared with a service on this machine, for `decode`, to be closed.

        Args:
            size: bytes; 0 for a pair of the service's camera.

        Raises:
            InvalidInputError: the service is not at a Unix socket.
            LightpageError: it shares no memory, or not as much.
        """
        if not size:
            told = self._description or self.describe()
            size = 2 * int(np.prod(told.frame_shape)) * np.dtype(told.frame_dtype).itemsize
        return SharedMemory(self.target, size)

    def decode_pages(
        self,
        pairs: Iterable[FramePair],
        levels: int = 0,
        *,
        bit_depth: int | None = None,
        black_level: int = 0,
        pilots: KnownPilots | None = None,
        correlation_id: str = "",
        timeout_s: float = DATA_S,
        **options: Unpack[PageOptions],
    ) -> Iterator[RemotePage | LightpageError]:
        """Send frame pairs one after another in one call; each one's page, or why there is none, in their order.

        The service reads the next pair while it decodes one. `RemotePage.frame_id` counts the pairs from 0.

        Args:
            pairs: taken as fast as the service reads them.
            timeout_s: for all of them.
            levels, bit_depth, black_level, pilots, correlation_id, options: of every pair, as for `decode`.

        Raises:
            FrameError: frames that cannot be sent.
            LightpageError: the whole call ended.
        """
        failed: list[Exception] = []
        bit_depth = self._bit_depth() if bit_depth is None else bit_depth

        def parts() -> Iterator[FramePart]:
            try:
                for number, pair in enumerate(pairs):
                    header = self._header(pair, levels, bit_depth, black_level, pilots, correlation_id, options)
                    set_fields(header, frame_id=number)
                    yield from pair_parts(header, sent_frames(pair))
            except Exception as error:  # gRPC would tell of it on stderr, and end the call with UNKNOWN
                failed.append(error)

        try:
            with self._stream(self._decode_pages(parts(), timeout=timeout_s)) as replies:
                for reply in replies:
                    refused = reply.WhichOneof("outcome") == "refused"
                    yield error_from(reply.refused.detail) if refused else answers.remote_page(reply.decoded)
        except LightpageError:
            if not failed:
                raise
        if failed:
            raise failed[0]

    def read_page(
        self,
        page: int | None = None,
        levels: int | None = None,
        *,
        want_written: bool = False,
        request_id: str = "",
        correlation_id: str = "",
        **options: Unpack[PageOptions],
    ) -> RemotePage:
        """Have the service read a page from its source; None stands for the next page and the source's levels.

        Args:
            page: its number.
            levels: M, 2..256.
            want_written: also get what the source knows to have been written.
            request_id: a text that is new for each page. Asked again with the same one, the service takes no second
                shot: it gives the same answer, with `RemotePage.replayed` set.
            correlation_id: a text that the page and the log have.
            options: what to get, and whose pages the page is followed with; see `PageOptions`.

        Raises:
            SourceError: the service has no source, or one that is damaged or dark.
            LostPageError: the page is lost; its `reason` says why.
            PageError: no such page, or an impossible level count.
            RequestIdError: the request id was given with another request.
            SlotsTakenError: the service had no free slot until the deadline.
        """
        request = message_of(
            pb.ReadPageRequest,
            page=page,
            options=options_message(levels or 0, options),
            want_written=want_written,
            request_id=request_id,
            correlation_id=correlation_id,
        )
        reply: pb.ReadPageReply = self._unary(self._stub.ReadPage, request)
        return answers.remote_page(reply.decoded, reply)

    def read_pages(
        self,
        pages: Sequence[int] = (),
        levels: int | None = None,
        *,
        count: int = 0,
        want_written: bool = False,
        correlation_id: str = "",
        timeout_s: float = DATA_S,
        **options: Unpack[PageOptions],
    ) -> Iterator[RemotePage | LightpageError]:
        """Have the service read pages from its source in one call; each page, or why there is none, in their order.

        Args:
            pages: their numbers; none for the next `count`.
            timeout_s: for all of them.
            levels, want_written, correlation_id, options: of every page, as for `read_page`.

        Raises:
            SourceError: the service has no source.
            LimitError: more pages than the service reads in one call.
            LightpageError: the whole call ended.
        """
        request = message_of(
            pb.ReadPagesRequest,
            pages=pages,
            count=count,
            options=options_message(levels or 0, options),
            want_written=want_written,
            correlation_id=correlation_id,
        )
        with self._stream(self._stub.ReadPages(request, timeout=timeout_s)) as replies:
            for reply in replies:
                refused = reply.WhichOneof("outcome") == "refused"
                yield (
                    error_from(reply.refused.detail) if refused else answers.remote_page(reply.read.decoded, reply.read)
                )

    def read_data(self, first: int, pages: int, timeout_s: float = DATA_S) -> Iterator[RemoteData]:
        """Have the service read the bytes of pages `first` to `first + pages - 1` of its source.

        Lost pages come as such; those that parity restores follow at the end of their group.

        Raises:
            BundleError: the model in service has no code.
            SourceError: the service has no source, or one that is damaged or dark.
            PageError: no such page.
        """
        with self._stream(
            self._stub.ReadData(message_of(pb.ReadDataRequest, first_page=first, pages=pages), timeout=timeout_s)
        ) as replies:
            for reply in replies:
                yield answers.remote_data(reply)

    def upload_pages(self, symbols: NDArray[np.uint8], levels: int) -> int:
        """Give the source's modulator pages [page, ny, nx] of M levels to show; returns the first one's number.

        Raises:
            SourceError: the source shows no pages that it is given.
            PageError: another shape, or symbols beyond the levels.
            InvalidInputError: other levels than the pages that are there.
            LimitError: more than the service holds.
        """
        pages = np.ascontiguousarray(symbols, np.uint8)
        pages = pages.reshape(-1, *pages.shape[-2:])

        first = message_of(pb.UploadPagesRequest, levels=levels)

        def parts() -> Iterator[pb.UploadPagesRequest]:
            yield first
            step = max(1, CHUNK_BYTES // max(1, pages[0].size)) if len(pages) else 1
            for start in range(0, len(pages), step):
                yield pb.UploadPagesRequest(symbols=pages[start : start + step].tobytes())

        reply: pb.UploadPagesReply = self._unary(self._stub.UploadPages, parts())
        return reply.first_page

    def display_orders(self, timeout_s: float | None = None) -> Iterator[DisplayOrder]:
        """What the service waits for a controller to show, at first and at every change, until the iterator is closed.

        Raises:
            SourceError: the source's device shows its pages, and moves its shutters, by itself.
        """
        with self._stream(self._stub.WatchDisplay(pb.WatchDisplayRequest(), timeout=timeout_s)) as replies:
            for reply in replies:
                yield answers.display_order(reply)

    def page_shown(self, page: int | None) -> None:
        """Say which page is on display and has settled; None for none from now on.

        Raises:
            SourceError: the source's device shows its pages by itself.
        """
        shown = {"withdrawn": True} if page is None else {"page": page}
        self._unary(self._stub.ReportDisplay, message_of(pb.ReportDisplayRequest, **shown))

    def beams_set(self, *, signal: bool, reference: bool) -> None:
        """Say which beams are let through and have settled.

        Raises:
            SourceError: the source's device moves its shutters by itself.
        """
        beams = pb.Beams(signal=signal, reference=reference)
        self._unary(self._stub.ReportDisplay, pb.ReportDisplayRequest(beams=beams))

    def recalibrate(
        self,
        *,
        count: int = 0,
        pages: Sequence[int] = (),
        recording: str | None = None,
        progress: Callable[[str, float], None] = lambda step, fraction: None,
        timeout_s: float = RECALIBRATION_S,
        expected_version: str = "",
    ) -> Recalibrated:
        """Recalibrate with pages of the source (`pages`, or the next `count`) or with a recording on the server.

        Of a recording the first `count` pages are used, all of them where it is 0. `expected_version` must be in
        service; empty stands for any. The recalibration is dropped when the call ends early: see `start_recalibration`.

        Raises:
            RecalibrationRefusedError: the new model would not be better; the old one stays.
            BusyError: another recalibration runs; its `job` says which.
            OtherModelError: another model is in service than was expected.
            JobCancelledError: somebody has cancelled it.
            LimitError: more pages than the service takes.
            InvalidInputError: no such pages or recording, too few pages, the same one twice, or unknown symbols.
            SourceError: the service has no source or recordings, or damaged ones, or no symbols of its own pages.
            StoppingError: the service is being stopped.
            BundleError: the new model cannot be written or noted; the old one stays.
        """
        asked = recalibration_pages(count, pages, recording)
        request = message_of(pb.RecalibrateRequest, expected_version=expected_version, **asked)
        result = None
        with self._stream(self._stub.Recalibrate(request, timeout=timeout_s)) as replies:
            for reply in replies:  # to its end: a call that is left early counts as cancelled
                if reply.WhichOneof("step") == "result":
                    result = answers.recalibrated(reply.result)
                else:
                    progress(reply.progress.step, reply.progress.fraction)
        if result is None:
            raise LightpageError(f"service at {self.target}", "an end without a result", "a recalibration's result")
        return result

    def start_recalibration(
        self,
        *,
        count: int = 0,
        pages: Sequence[int] = (),
        recording: str | None = None,
        expected_version: str = "",
        correlation_id: str = "",
    ) -> JobInfo:
        """Start a recalibration and return at once; it goes on by itself, see `watch_job`.

        Args:
            count: how many of the source's next pages, or of the recording's first ones.
            pages: which pages of the source.
            recording: its name in the service's recordings folder.
            expected_version: that must be in service; empty for any.
            correlation_id: a text that the job carries.

        Raises:
            BusyError: another recalibration runs; its `job` says which.
            OtherModelError: another model is in service than was expected.
            LimitError: more pages than the service takes.
            InvalidInputError: no such recording.
            SourceError: the service has no source or recordings.
        """
        request = message_of(
            pb.StartRecalibrationRequest,
            expected_version=expected_version,
            correlation_id=correlation_id,
            **recalibration_pages(count, pages, recording),
        )
        return answers.job_info(self._unary(self._stub.StartRecalibration, request))

    def recalibrate_frames(
        self,
        pairs: Sequence[FramePair],
        symbols: Sequence[NDArray[np.uint8]],
        references: FramePair,
        *,
        levels: int,
        bit_depth: int | None = None,
        black_level: int = 0,
        pilot_mask: NDArray[np.bool_] | None = None,
        expected_version: str = "",
        correlation_id: str = "",
        timeout_s: float = DATA_S,
    ) -> JobInfo:
        """Send pages with known symbols and start a recalibration with them, which goes on by itself.

        Args:
            pairs: frame pairs, one a page.
            symbols: what was written, [ny, nx], one a page.
            references: reference-only frames taken with them.
            levels: M of the symbols.
            bit_depth: bits of a camera count; by default those of the service's camera.
            black_level: counts that the cameras add to every pixel.
            pilot_mask: where the pilots are, [ny, nx]; None for the device's own.
            expected_version: that must be in service; empty for any.
            correlation_id: a text that the job carries.
            timeout_s: for sending it all.

        Raises:
            FrameError: frames that cannot be sent, or that the service refuses.
            PageError: symbols or pilots that do not fit the page, or an impossible level count.
            BusyError: another recalibration runs; its `job` says which.
            OtherModelError: another model is in service than was expected.
            LimitError: more pages than the service takes.
            InvalidInputError: too few pages, the same one twice, or not as many symbols as pairs.
        """
        if len(pairs) != len(symbols):
            got = f"{len(pairs)} frame pairs and {len(symbols)} pages of symbols"
            raise InvalidInputError("pages to recalibrate with", got, "as many of both")
        first = sent_frames(references, "reference: ")
        header = message_of(
            pb.RecalibrateFramesHeader,
            rows_px=first[0].shape[0],
            columns_px=first[0].shape[1],
            pixel_type=PIXEL_CODES[first[0].dtype.name],
            bit_depth=self._bit_depth() if bit_depth is None else bit_depth,
            black_level=black_level,
            levels=levels,
            pages=len(pairs),
            pilot_mask=b"" if pilot_mask is None else np.asarray(pilot_mask, bool).astype(np.uint8).tobytes(),
            expected_version=expected_version,
            correlation_id=correlation_id,
        )
        pages = [
            (sent_frames(pair, f"known page {number}: "), sent_symbols(page, f"known page {number}: symbols"))
            for number, (pair, page) in enumerate(zip(pairs, symbols, strict=True))
        ]
        for number, (frames, _) in enumerate(pages):
            if (frames[0].shape, frames[0].dtype) != (first[0].shape, first[0].dtype):
                got, expected = (f"{one.dtype} {one.shape}" for one in (frames[0], first[0]))
                raise FrameError(f"known page {number}: frames", got, f"{expected}, as the reference frames")

        def parts() -> Iterator[pb.RecalibrateFramesRequest]:
            yield pb.RecalibrateFramesRequest(header=header)
            for chunk in map(bytes, chunks_of(first)):
                yield pb.RecalibrateFramesRequest(reference=chunk)
            for frames, page in pages:
                yield pb.RecalibrateFramesRequest(symbols=page)
                for chunk in map(bytes, chunks_of(frames)):
                    yield pb.RecalibrateFramesRequest(chunk=chunk)

        return answers.job_info(self._unary(self._stub.RecalibrateFrames, parts(), timeout_s))

    def jobs(self) -> list[JobInfo]:
        """Jobs that run, and those that ended lately, the newest first.

        Raises:
            LightpageError: no answer.
        """
        reply: pb.ListJobsReply = self._unary(self._stub.ListJobs, pb.ListJobsRequest())
        return [answers.job_info(job) for job in reply.jobs]

    def job(self, job_id: str) -> JobInfo:
        """A job as it is now.

        Raises:
            NoSuchJobError: there is no such job, or it ended long ago.
        """
        return answers.job_info(self._unary(self._stub.GetJob, message_of(pb.GetJobRequest, id=job_id)))

    def watch_job(self, job_id: str, timeout_s: float = RECALIBRATION_S) -> Iterator[JobInfo]:
        """A job as it is now, and at each change, until it has ended.

        A connection that is lost on the way, or a service that starts again, is waited for.

        Raises:
            NoSuchJobError: there is no such job, or it ended long ago.
            LightpageError: no answer at all, or the job has not ended within `timeout_s`; it goes on.
        """
        until, last = self._clock.now() + timeout_s, None
        request = message_of(pb.WatchJobRequest, id=job_id)
        while True:
            left_s = until - self._clock.now()
            call = self._stub.WatchJob(request, timeout=max(0.0, min(left_s, _WATCH_S)))
            try:
                for job in call:
                    if job != last:
                        last = job
                        yield answers.job_info(job)
                    if job.state != pb.JOB_STATE_RUNNING:
                        return
            except grpc.RpcError as error:
                if last is None or self._clock.now() >= until or not is_lost_connection(error):
                    raise error_of(error, self.target) from None
            finally:
                call.cancel()
            self._clock.sleep(min(_AGAIN_S, until - self._clock.now()))

    def cancel_job(self, job_id: str) -> JobInfo:
        """Have a job end at its next step; returns it as it is then. One that has ended stays as it is.

        Raises:
            NoSuchJobError: there is no such job, or it ended long ago.
        """
        return answers.job_info(self._unary(self._stub.CancelJob, message_of(pb.CancelJobRequest, id=job_id)))

    def rollback(self, expected_version: str = "") -> tuple[str, str]:
        """Go back to the model before; returns the versions (now current, before).

        Args:
            expected_version: that must be in service, empty for any: a call that is repeated with it steps back once.

        Raises:
            OtherModelError: another one is.
            BundleError: there is none, or the change cannot be noted in the service's store; then nothing changes.
        """
        request = message_of(pb.RollbackRequest, expected_version=expected_version)
        return self._changed(self._stub.Rollback, request)

    def roll_forward(self, expected_version: str = "") -> tuple[str, str]:
        """Go to the later model again, after a roll-back; else as `rollback`."""
        request = message_of(pb.RollForwardRequest, expected_version=expected_version)
        return self._changed(self._stub.RollForward, request)

    def models(self, stored: bool = False) -> list[ModelInfo]:
        """All models that the service holds loaded, the oldest first; before them those that only its store has.

        Args:
            stored: whether to name the latter too.

        Raises:
            LightpageError: no answer.
        """
        reply: pb.ListModelsReply = self._unary(self._stub.ListModels, pb.ListModelsRequest(stored=stored))
        return [answers.model_info(model) for model in reply.models]

    def upload_model(self, path: str | Path, timeout_s: float = UPLOAD_S) -> ModelInfo:
        """Give the service a bundle, a zip file. It is kept in the store, not put in service.

        A signature beside it, in a file with `.sig` behind its name, goes along.

        Raises:
            InvalidInputError: no file that can be read.
            ModelExistsError: the service has a model of its version.
            BundleError: it is damaged, or for another device, or its signature is no good.
            StoreError: the service has no store, or one that cannot be written.
            LimitError: it is too large.
        """
        path = Path(path)
        try:
            with path.open("rb") as file:
                header = pb.UploadModelHeader(
                    bytes=os.fstat(file.fileno()).st_size,
                    sha256=hashlib.file_digest(file, "sha256").digest(),
                    signature=read_signature(path),
                )
                file.seek(0)

                def parts() -> Iterator[pb.UploadModelRequest]:
                    yield pb.UploadModelRequest(header=header)
                    while chunk := file.read(CHUNK_BYTES):
                        yield pb.UploadModelRequest(chunk=chunk)

                reply: pb.UploadModelReply = self._unary(self._stub.UploadModel, parts(), timeout_s)
        except OSError as error:
            raise InvalidInputError(f"bundle {path}", error, "a zip file that can be read") from None
        return answers.model_info(reply.model)

    def activate_model(self, version: str, expected_version: str = "") -> tuple[str, str]:
        """Put a model in service that the service has; returns the versions (now current, before).

        Args:
            version: of it.
            expected_version: that must be in service, empty for any.

        Raises:
            OtherModelError: another one is.
            BundleError: there is none, it is damaged, or the change cannot be noted; then nothing changes.
        """
        request = message_of(pb.ActivateModelRequest, version=version, expected_version=expected_version)
        return self._changed(self._stub.ActivateModel, request)

    def pin_model(self, version: str, pinned: bool = True) -> ModelInfo:
        """See that a model is never deleted, nor replaced by the service itself; or let go of it.

        Raises:
            BundleError: there is none, or it cannot be noted.
        """
        request = message_of(pb.PinModelRequest, version=version, pinned=pinned)
        reply: pb.PinModelReply = self._unary(self._stub.PinModel, request)
        return answers.model_info(reply.model)

    def _bit_depth(self) -> int:
        """Of the service's camera."""
        return (self._description or self.describe()).bit_depth

    def _header(
        self,
        pair: FramePair,
        levels: int,
        bit_depth: int | None,
        black_level: int,
        pilots: KnownPilots | None,
        correlation_id: str,
        options: PageOptions,
    ) -> pb.DecodeHeader:
        """What is sent before a pair; raises `FrameError` where that cannot be sent."""
        frame, asked = sent_frames(pair)[0], options_message(levels, options)
        if asked.tracking != pb.TRACKING_STATELESS:
            asked.session = asked.session or self._session
        return message_of(
            pb.DecodeHeader,
            rows_px=frame.shape[0],
            columns_px=frame.shape[1],
            pixel_type=PIXEL_CODES[frame.dtype.name],
            bit_depth=self._bit_depth() if bit_depth is None else bit_depth,
            black_level=black_level,
            options=asked,
            pilots=pilots_message(pilots) if pilots is not None else None,
            correlation_id=correlation_id,
        )

    @contextmanager
    def _stream(self, call: Any) -> Iterator[Any]:
        """The replies of a call, which ends with the `with` statement; its errors are our own."""
        try:
            yield call
        except grpc.RpcError as error:
            raise error_of(error, self.target) from None
        finally:
            call.cancel()

    def _changed(self, method: Callable[..., Any], request: object) -> tuple[str, str]:
        """Have another model put in service; the versions (now current, before)."""
        reply = self._unary(method, request)
        return reply.model_version, reply.previous_version

    def _unary(self, method: Callable[..., Any], request: object, timeout_s: float | None = None) -> Any:
        try:
            return method(request, timeout=self._timeout if timeout_s is None else timeout_s)
        except grpc.RpcError as error:
            raise error_of(error, self.target) from None
