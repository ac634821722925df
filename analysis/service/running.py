"""A service in a process of its own, as an operator starts it."""

from __future__ import annotations

import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

import grpc
import numpy as np

from lightpage.recording.frame_pair import FramePair
from lightpage.recording.writer import RecordingWriter
from lightpage.runtime.client.pb.inference import open_inference_pb2 as oip
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2_grpc as pb_grpc
from lightpage.runtime.client.wire.messages import message_of
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.bundle.shipped import DEFAULT, bundle_path
from lightpage.runtime.service.frames.inference_calls import MODEL

START_S = 120.0
_CHUNK = 1 << 20


class RunningService:
    """`lightpage serve` until it is ended; use it in a `with` statement.

    Args:
        arguments: arguments of the command, beside addresses.
        environment: variables that it has beside those of this process.
        before: words before the command, of a program that becomes it, as `env` does.
    """

    def __init__(
        self, *arguments: str, environment: Mapping[str, str] | None = None, before: Sequence[str] = ()
    ) -> None:
        self._arguments, self._environment = arguments, {**os.environ, **(environment or {})}
        self._before = before
        self._log = tempfile.TemporaryFile("w+")  # noqa: SIM115  # closed with the service
        self.process: subprocess.Popen[str] | None = None
        self.target = self.health = self._metrics = ""
        self.ready_s = self.ready_cpu_s = 0.0

    def start(self) -> Self:
        """Start it and wait until it serves.

        Raises:
            RuntimeError: it ended before.
        """
        begun = time.monotonic()
        command = [sys.executable, "-m", "lightpage.cli.main", "serve", "--address", "127.0.0.1:0"]
        self.process = subprocess.Popen(
            [*self._before, *command, "--metrics-port", "0", *self._arguments],
            stdout=subprocess.PIPE,
            stderr=self._log,
            stdin=subprocess.DEVNULL,
            env=self._environment,
            text=True,
        )
        timer = threading.Timer(START_S, self.process.kill)
        timer.start()
        try:
            assert self.process.stdout is not None  # asked for
            for line in self.process.stdout:
                if found := re.search(r"metrics at (\S+)", line):
                    self._metrics = found[1].rstrip(",")
                elif found := re.search(r"health checks at (\S+)", line):
                    self.health = found[1]
                elif found := re.search(r"^serving .* at (\S+)$", line):
                    self.target = found[1]
                    self.ready_s, self.ready_cpu_s = time.monotonic() - begun, self.cpu_s()
                    return self
        finally:
            timer.cancel()
        raise RuntimeError(f"the service ended with {self.process.wait()}: {self.log()[-2000:]}")

    def log(self) -> str:
        """Return all that the service has written to stderr."""
        self._log.seek(0)
        return self._log.read()

    def cpu_s(self) -> float:
        """CPU seconds of its process so far."""
        fields = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / 100

    def resident_bytes(self) -> int:
        """Return the resident memory of the service, bytes."""
        return int(Path(f"/proc/{self.pid}/statm").read_text().split()[1]) * resource.getpagesize()

    @property
    def metrics(self) -> str:
        """Address of its metrics."""
        return self._metrics

    def metric(self, name: str, **labels: str) -> float:
        """Sum of the samples of a metric with these labels."""
        wanted = [f'{key}="{value}"' for key, value in labels.items()]
        with urllib.request.urlopen(self._metrics, timeout=20) as answer:
            lines = answer.read().decode().splitlines()
        return sum(
            float(line.rpartition(" ")[2])
            for line in lines
            if re.match(rf"{name}(\{{| )", line) and all(each in line for each in wanted)
        )

    def page(self, name: str) -> str:
        """Address of a page of its web server."""
        return self._metrics.replace("/metrics", f"/{name}")

    def channel(self) -> grpc.Channel:
        """A connection of its own."""
        options = (("grpc.use_local_subchannel_pool", 1), ("grpc.max_receive_message_length", 64 << 20))
        return grpc.insecure_channel(self.target, options=options)

    def kill(self) -> None:
        """End it as a power cut does."""
        assert self.process is not None  # it was started
        self.process.kill()
        self.process.wait()

    def stop(self, wait_s: float = 60.0) -> int:
        """End it with SIGTERM; returns its exit status."""
        assert self.process is not None  # it was started
        self.process.send_signal(signal.SIGTERM)
        try:
            return self.process.wait(wait_s)
        except subprocess.TimeoutExpired:
            self.kill()
            return -signal.SIGKILL

    def __enter__(self) -> Self:
        return self if self.process is not None else self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.process is not None and self.process.poll() is None:
            self.stop()
        if self.process is not None and self.process.stdout is not None:
            self.process.stdout.close()
        self._log.close()

    @property
    def pid(self) -> int:
        """Number of its process."""
        assert self.process is not None  # it was started
        return self.process.pid


class PagesToSend:
    """The shipped bundle's golden pair as requests."""

    def __init__(self) -> None:
        bundle = Bundle.open(bundle_path(DEFAULT))
        self.pair, self._bundle = bundle.golden.pair, bundle

    def header(self, **changes: object) -> pb.DecodeHeader:
        """The header of a pair."""
        rows, columns = self._bundle.profile.frame_shape
        manifest = self._bundle.manifest
        own = {"rows_px": rows, "columns_px": columns, "bit_depth": manifest.camera_bit_depth}
        return message_of(pb.DecodeHeader, **own | {"pixel_type": manifest.frame_dtype} | changes)

    def requests(self, pair: FramePair | None = None, **changes: object) -> list[pb.DecodeFramesRequest]:
        """Messages of DecodeFrames."""
        pair = pair or self.pair
        data = b"".join(frame.tobytes() for frame in (pair.in_phase, pair.quadrature))
        chunks = [pb.DecodeFramesRequest(chunk=data[at : at + _CHUNK]) for at in range(0, len(data), _CHUNK)]
        return [pb.DecodeFramesRequest(header=self.header(**changes)), *chunks]

    def inference(self) -> bytes:
        """The pair as a message of ModelInfer."""
        request = oip.ModelInferRequest(model_name=MODEL)
        for name, frame in (("in_phase", self.pair.in_phase), ("quadrature", self.pair.quadrature)):
            request.inputs.add(name=name, datatype=str(frame.dtype).upper(), shape=frame.shape)
            request.raw_input_contents.append(frame.tobytes())
        return request.SerializeToString()

    def record(self, path: Path, pages: int = 2) -> Path:
        """Write a recording in which every page is the golden one, and return its path."""
        profile = self._bundle.profile
        shape, bits = profile.frame_shape, self._bundle.manifest.camera_bit_depth
        dark = np.full(shape, 20, self.pair.in_phase.dtype)
        with RecordingWriter(path, profile, 256, bits, FramePair(dark, dark), resume=True) as writer:
            for _ in range(pages):
                writer.append(None, self.pair)
        return path


def stub(channel: grpc.Channel) -> pb_grpc.LightpageStub:
    """The service's methods."""
    return pb_grpc.LightpageStub(channel)  # type: ignore[no-untyped-call]


def quantiles_ms(seconds: Sequence[float]) -> dict[str, float]:
    """p50, p99 and the largest, milliseconds."""
    p50, p99, largest = 1e3 * np.quantile(seconds, [0.5, 0.99, 1.0])
    return {"count": len(seconds), "p50_ms": float(p50), "p99_ms": float(p99), "max_ms": float(largest)}


def until(end: float, step_s: float = 0.0) -> Iterator[float]:
    """Moments until `end`, `time.monotonic` seconds, at least `step_s` apart."""
    while (now := time.monotonic()) < end:
        yield now
        time.sleep(max(0.0, now + step_s - time.monotonic()))
