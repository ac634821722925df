"""Services with a toy device, all their parts in reach, and what is sent to them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import grpc
import numpy as np
from google.protobuf.message import Message
from google.rpc import error_details_pb2, status_pb2

from lightpage.errors import LightpageError
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.client.answers import JobInfo
from lightpage.runtime.client.client import LightpageClient
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2_grpc as pb_grpc
from lightpage.runtime.client.wire.status import STATUS_KEY, error_of
from lightpage.runtime.device.acquisition.source import Shot
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.tracking import NoTracker
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.jobs.recalibrator import Recalibrator
from lightpage.runtime.service.models.database import DATABASE
from lightpage.runtime.service.models.folder import LOCK, PROBE, BundleFolder
from lightpage.runtime.service.server.server import LightpageServer
from tests.runtime import toy

OWN_CONNECTION = (("grpc.use_local_subchannel_pool", 1),)
"""Options of a channel that shares its connection with no other."""


@dataclass
class Running:
    """A service with all its parts in reach; its stub is on a channel of its own."""

    plane: DataPlane
    recalibrator: Recalibrator
    server: LightpageServer
    source: Any
    client: LightpageClient
    channels: list[grpc.Channel] = field(default_factory=list)

    @property
    def device(self) -> toy.ToyDevice:
        return self.source.device  # type: ignore[no-any-return]

    @property
    def version(self) -> str:
        return self.plane.models.current.version

    @property
    def store(self) -> BundleFolder:
        return self.plane.models.store.folder

    @property
    def left_behind(self) -> list[str]:
        """Names in the store beside its database, its bundles, and a probe that tries whether it can be written."""
        names = [path.name for path in self.store.path.iterdir() if not path.name.startswith((PROBE, LOCK, DATABASE))]
        return [name for name in names if name[0] == "." or not name.endswith(".zip")]

    def count(self, name: str, **labels: str) -> float:
        """What the service's metrics say."""
        return self.plane.metrics.registry.get_sample_value(name, labels) or 0.0

    def channel(self) -> grpc.Channel:
        """A connection of its own, closed with the service."""
        self.channels.append(grpc.insecure_channel(self.server.target, OWN_CONNECTION))
        return self.channels[-1]

    @property
    def stub(self) -> pb_grpc.LightpageStub:
        return pb_grpc.LightpageStub(self.channels[0] if self.channels else self.channel())

    def last(self, job: JobInfo) -> JobInfo:
        """The job once it has ended."""
        *_, end = self.client.jobs.watch(job.id, 20)
        return end

    def reading(self, shot: Callable[[Shot], Shot]) -> None:
        """Let the source show what a function makes of its shots."""
        as_it_was = self.source.shot
        self.source.shot = lambda timeout_s=1.0, page=None: shot(as_it_was(timeout_s, page))

    def end(self) -> None:
        self.client.close()
        for channel in self.channels:
            channel.close()
        self.server.stop(0.5)
        self.plane.models.store.close()


Start = Callable[..., Running]


@contextmanager
def served(servicer: pb_grpc.LightpageServicer, port: int = 0) -> Iterator[int]:
    """A server of nothing else on a port of this machine."""
    server = grpc.server(ThreadPoolExecutor(4))
    pb_grpc.add_LightpageServicer_to_server(servicer, server)  # type: ignore[no-untyped-call]
    port = server.add_insecure_port(f"127.0.0.1:{port}")
    server.start()
    yield port
    server.stop(grace=None).wait(60)


def a_page(levels: int = 16, seed: int = 3) -> tuple[np.ndarray, FramePair]:
    symbols = toy.symbols_of(levels, seed)[0]
    return symbols, toy.ToyDevice(seed=seed).page(symbols, levels, 0.7)


def raised(pair: FramePair, counts: int) -> FramePair:
    """The pair of a camera whose black level is so many counts higher."""
    frames = (pair.in_phase, pair.quadrature)
    return FramePair(*(np.minimum(frame, 255 - counts) + np.uint8(counts) for frame in frames))


def header(**changes: Any) -> pb.DecodeHeader:
    rows, columns = toy.PROFILE.frame_shape
    given = {"rows_px": rows, "columns_px": columns, "pixel_type": pb.PIXEL_TYPE_UINT8, "bit_depth": 8, **changes}
    return pb.DecodeHeader(**{"options": pb.DecodeOptions(levels=16), **given})


def parts(pair: FramePair, **changes: Any) -> Iterator[pb.DecodeFramesRequest]:
    yield pb.DecodeFramesRequest(header=header(**changes))
    for frame in (pair.in_phase, pair.quadrature):
        yield pb.DecodeFramesRequest(chunk=frame.tobytes())


def until_told(messages: Sequence[Any], more: threading.Event) -> Iterator[Any]:
    """A stream that stays open behind its messages until it is told to end."""
    yield from messages
    more.wait(60)


@dataclass(frozen=True)
class Refused:
    """How a call failed; `told` has google.rpc's details by name."""

    code: grpc.StatusCode
    text: str
    told: dict[str, Any]
    error: LightpageError

    @property
    def reason(self) -> str:
        return self.told["ErrorInfo"].reason if self.told else ""

    @property
    def subject(self) -> str:
        return self.error.subject


def refused_as(error: Any) -> Refused:
    """What an error of gRPC's says."""
    packed = dict(error.trailing_metadata() or ()).get(STATUS_KEY)
    told: dict[str, Any] = {}
    if packed is not None:
        status = status_pb2.Status.FromString(packed)
        assert status.code == error.code().value[0]
        for each in status.details:
            for kind in (error_details_pb2.ErrorInfo, error_details_pb2.RetryInfo, error_details_pb2.BadRequest):
                message: Message = kind()
                if each.Unpack(message):
                    told[kind.__name__] = message
    return Refused(error.code(), error.details(), told, error_of(error, "here"))


def refused(call: Callable[[], Any]) -> Refused:
    """How a call fails, or a stream of replies on its way."""
    try:
        answer = call()
        if hasattr(answer, "__next__"):
            list(answer)
    except grpc.RpcError as error:
        return refused_as(error)
    raise AssertionError("the call was answered")


class Remembering(NoTracker):
    """Its answers depend on what it decoded before, as those of a tracker do that was led astray."""

    def __init__(self, decoder: Decoder) -> None:
        super().__init__(decoder)
        self._mine, self.pages = decoder, 0

    def decode(self, *arguments: Any) -> Any:
        page = super().decode(*arguments)
        self.pages += 1
        return type(page)(**{**vars(page), "piston_rad": float(self.pages)})

    def anew(self) -> Remembering:
        return Remembering(self._mine)
