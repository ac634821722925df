"""The gRPC face of the service: every method translates a message, calls the data plane and translates the answer."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version as installed_version

import grpc

from lightpage.errors import FrameError, InvalidInputError, LimitError
from lightpage.page.symbols import MAX_LEVELS
from runtime.modulator.beam_state import BeamState
from runtime.pb.lightpage.v1 import lightpage_pb2 as pb
from runtime.pb.lightpage.v1 import lightpage_pb2_grpc as pb_grpc
from runtime.rpc.replies import data_reply, decode_reply, model_message, read_reply, result_message, wanted_message
from runtime.rpc.uploads import uploaded_pages
from runtime.service.caller import Caller
from runtime.service.dataplane import DataPlane, levels_for
from runtime.service.recalibrator import Recalibrator, Step
from runtime.service.user_data import read_data
from runtime.wire.messages import PIXEL_CODES, check_options, pilots_of, pixel_type
from runtime.wire.status import abort, status_of, without_folders

_MOST_PAGES = 1 << 32
"""Of a source: their numbers travel in 32 bits."""

_log = logging.getLogger(__name__)


class LightpageServicer(pb_grpc.LightpageServicer):
    """Translates between gRPC and the data plane; holds no logic and no state of its own."""

    def __init__(self, plane: DataPlane, recalibrator: Recalibrator) -> None:
        self._plane, self._recalibrator = plane, recalibrator

    def Describe(self, request: pb.DescribeRequest, context: grpc.ServicerContext) -> pb.DescribeReply:
        """What the service is."""
        with self._call("Describe", context):
            plane, model = self._plane, self._plane.registry.current
            bundle, limits = model.decoder.bundle, self._plane.limits
            (rows_px, columns_px), (rows, columns) = bundle.profile.frame_shape, bundle.profile.page_shape
            return pb.DescribeReply(
                service_version=installed_version("lightpage"),
                model=model_message(model, True),
                camera=pb.Camera(
                    rows_px=rows_px,
                    columns_px=columns_px,
                    bit_depth=bundle.manifest.camera_bit_depth,
                    pixel_type=PIXEL_CODES[bundle.manifest.frame_dtype],
                ),
                page=pb.PageShape(rows=rows, columns=columns),
                limits=pb.Limits(
                    message_bytes=limits.message_bytes,
                    chunk_bytes=limits.chunk_bytes,
                    pair_bytes=limits.pair_bytes,
                    concurrent_decodes=limits.concurrent_decodes,
                ),
                source=without_folders(plane.source.name) if plane.has_source else "",
                source_levels=plane.source.levels if plane.has_source else 0,
                profile_toml=bundle.manifest.profile,
                calibration_toml=bundle.manifest.calibration,
                pilot_mask=bundle.pilot_mask.astype("uint8").tobytes(),
                code_toml=bundle.manifest.code or "",
                user_bytes_per_page=0 if bundle.code is None else model.decoder.page_codec.user_bytes,
                pilot_phases=() if bundle.pilot_phases is None else bundle.pilot_phases.tolist(),
            )

    def DecodeFrames(
        self, request_iterator: Iterator[pb.DecodeFramesRequest], context: grpc.ServicerContext
    ) -> pb.DecodeReply:
        """Receive a frame pair and decode it."""
        start = time.perf_counter()
        receive_s = self._plane.limits.receive_s
        with self._call("DecodeFrames", context):
            with _stall_guard(context, receive_s):
                header = _header(request_iterator)
            check_options(header.options)
            caller, user_data = _caller(context), header.options.want_user_data
            levels = header.options.levels or None
            decoder = self._plane.registry.current.decoder
            page_shape, usual = decoder.bundle.profile.page_shape, levels_for(decoder, levels, MAX_LEVELS, user_data)
            pilots = pilots_of(header.pilots, page_shape, usual) if header.HasField("pilots") else None
            shape = (header.rows_px, header.columns_px)
            with self._plane.receiving(shape, pixel_type(header.pixel_type), header.bit_depth, caller) as receiver:
                with _stall_guard(context, receive_s):  # from here: waiting for the slot is not the client's doing
                    for part in request_iterator:
                        if part.WhichOneof("part") != "chunk":
                            raise InvalidInputError(
                                "message of DecodeFrames", "a second header", "chunks from there on"
                            )
                        if len(part.chunk) > self._plane.limits.chunk_bytes:
                            limit = self._plane.limits.chunk_bytes
                            raise LimitError("chunk", f"{len(part.chunk)} bytes", f"at most {limit}")
                        receiver.add(part.chunk)
                pair = receiver.pair()
                received = time.perf_counter()
                answer = self._plane.decode(
                    pair, levels, caller, pilots, user_data=user_data, start=start, received=received
                )
            return decode_reply(answer, header.options)

    def ReadPage(self, request: pb.ReadPageRequest, context: grpc.ServicerContext) -> pb.ReadPageReply:
        """Read a page from the source and decode it."""
        with self._call("ReadPage", context):
            check_options(request.options)
            page = request.page if request.HasField("page") else None
            options = request.options
            read = self._plane.read_page(
                page, options.levels or None, _caller(context), user_data=options.want_user_data
            )
            return read_reply(read, request)

    def ReadData(self, request: pb.ReadDataRequest, context: grpc.ServicerContext) -> Iterator[pb.ReadDataReply]:
        """Read the bytes of a range of pages."""
        with self._call("ReadData", context):
            limits = self._plane.limits
            if request.pages < 1:
                raise InvalidInputError("pages to read", request.pages, "at least 1")
            if request.pages > limits.range_pages:
                raise LimitError("pages to read", request.pages, f"at most {limits.range_pages}")
            if request.first_page + request.pages > _MOST_PAGES:
                raise InvalidInputError("first page to read", request.first_page, f"less than {_MOST_PAGES} with all")
            caller = _caller(context)
            with self._plane.ranges.held(caller), _stall_guard(context, limits.range_s):
                for page in read_data(self._plane, request.first_page, request.pages, caller):
                    yield data_reply(page)

    def UploadPages(
        self, request_iterator: Iterator[pb.UploadPagesRequest], context: grpc.ServicerContext
    ) -> pb.UploadPagesReply:
        """Receive pages to show."""
        with self._call("UploadPages", context):
            shape = self._plane.registry.current.decoder.bundle.profile.page_shape
            with _stall_guard(context, self._plane.limits.receive_s):
                levels, symbols = uploaded_pages(request_iterator, shape)
            first = self._plane.display.upload(symbols, levels)
            return pb.UploadPagesReply(first_page=first, pages=len(symbols))

    def WatchDisplay(
        self, request: pb.WatchDisplayRequest, context: grpc.ServicerContext
    ) -> Iterator[pb.WatchDisplayReply]:
        """Tell a controller what to show."""
        with self._call("WatchDisplay", context):
            caller = _caller(context)
            with self._plane.watches.held(caller):
                for wanted in self._plane.display.wanted(caller):
                    yield wanted_message(wanted)

    def ReportDisplay(self, request: pb.ReportDisplayRequest, context: grpc.ServicerContext) -> pb.ReportDisplayReply:
        """Hear from a controller what is shown."""
        with self._call("ReportDisplay", context):
            kind, display = request.WhichOneof("what"), self._plane.display
            if kind is None:
                raise InvalidInputError("report of the display", "nothing", "a page, its end, or beams")
            if kind == "beams":
                display.beams_set(BeamState(request.beams.signal, request.beams.reference))
            else:
                display.shown(request.page if kind == "page" else None)
            return pb.ReportDisplayReply()

    def Recalibrate(
        self, request: pb.RecalibrateRequest, context: grpc.ServicerContext
    ) -> Iterator[pb.RecalibrateReply]:
        """Recalibrate and tell how it goes."""
        with self._call("Recalibrate", context):
            caller, kind = _caller(context), request.WhichOneof("pages")
            if kind == "source":
                steps = self._recalibrator.from_source(request.source.count, list(request.source.pages), caller)
            elif kind == "recording":
                steps = self._recalibrator.from_recording(request.recording, request.recording_count, caller)
            else:
                raise InvalidInputError("pages to recalibrate with", "none", "pages of the source or a recording")
            for step in steps:
                if isinstance(step, Step):
                    yield pb.RecalibrateReply(progress=pb.Progress(step=step.name, fraction=step.fraction))
                else:
                    yield pb.RecalibrateReply(result=result_message(step))

    def Rollback(self, request: pb.RollbackRequest, context: grpc.ServicerContext) -> pb.RollbackReply:
        """Go back to the model before."""
        with self._call("Rollback", context):
            current, dropped = self._plane.rollback()
            return pb.RollbackReply(model_version=current.version, previous_version=dropped.version)

    def ListModels(self, request: pb.ListModelsRequest, context: grpc.ServicerContext) -> pb.ListModelsReply:
        """All models that are held."""
        with self._call("ListModels", context):
            models = self._plane.registry.models
            return pb.ListModelsReply(models=[model_message(model, model is models[-1]) for model in models])

    @contextmanager
    def _call(self, method: str, context: grpc.ServicerContext) -> Iterator[None]:
        """Count a call and turn what it raises into its status."""
        metrics, code = self._plane.metrics, grpc.StatusCode.OK
        metrics.in_flight.inc()
        try:
            yield
        except Exception as error:
            code = status_of(error)
            if code == grpc.StatusCode.INTERNAL:
                _log.exception("%s failed", method)
            abort(context, error)
        except GeneratorExit:
            code = grpc.StatusCode.CANCELLED
            raise
        finally:
            metrics.in_flight.dec()
            metrics.calls.labels(method, code.name).inc()


def _header(requests: Iterator[pb.DecodeFramesRequest]) -> pb.DecodeHeader:
    first = next(requests, None)
    if first is None or first.WhichOneof("part") != "header":
        raise FrameError("first message of DecodeFrames", "no header", "a header, then chunks")
    return first.header


def _caller(context: grpc.ServicerContext) -> Caller:
    def seconds_left() -> float:
        left = context.time_remaining()
        return float("inf") if left is None else float(left)

    return Caller(seconds_left, context.is_active)


@contextmanager
def _stall_guard(context: grpc.ServicerContext, seconds: float) -> Iterator[None]:
    """Cancel the call unless the `with` block ends within `seconds`.

    Reading the next message blocks without a deadline of its own; only ending the call wakes it.
    """
    timer = threading.Timer(seconds, context.cancel)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
