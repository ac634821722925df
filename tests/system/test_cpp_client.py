"""The client in C++ compiles without a warning, and every command of its example does what it says."""

from __future__ import annotations

import shutil
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from concurrent import futures
from contextlib import contextmanager
from pathlib import Path

import grpc
import numpy as np
import pytest
from google.protobuf.any_pb2 import Any as AnyMessage
from google.protobuf.duration_pb2 import Duration
from google.rpc import error_details_pb2, status_pb2

from runtime.decoding.decoder import Decoder
from runtime.identity.certificates import Certificates
from runtime.pb.lightpage.v1 import lightpage_pb2 as pb
from runtime.pb.lightpage.v1 import lightpage_pb2_grpc as pb_grpc
from runtime.rpc.server import LightpageServer
from runtime.service.dataplane import DataPlane
from runtime.service.recalibrator import Recalibrator
from runtime.service.registry import ModelRegistry, no_tracker
from tests.runtime import toy
from tests.runtime.identity.authority import Authority

ROOT = Path(__file__).resolve().parents[2]
PROGRAMS = ("cmake", "c++", "pkg-config", "protoc", "grpc_cpp_plugin")


def lacking() -> list[str]:
    """Programs and libraries that a C++ client is made with and that are not here."""
    if missing := [name for name in PROGRAMS if shutil.which(name) is None]:
        return missing
    libraries = ("grpc++", "protobuf")
    return [name for name in libraries if subprocess.run(["pkg-config", "--exists", name], timeout=20).returncode]


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The example, compiled."""
    if missing := lacking():
        pytest.skip(f"to compile C++ this lacks {', '.join(missing)}")
    build = tmp_path_factory.mktemp("cpp")
    for step in (["-S", ROOT / "clients/cpp", "-B", build], ["--build", build]):
        done = subprocess.run(["cmake", *map(str, step)], capture_output=True, text=True, timeout=500)
        assert done.returncode == 0, done.stdout[-5000:] + done.stderr[-5000:]
    return build / "lightpage_example"


def run(program: Path, target: str, *words: object, timeout_s: float = 30) -> subprocess.CompletedProcess[str]:
    command = [program, "--target", target, "--timeout", timeout_s, *words]
    return subprocess.run([str(word) for word in command], capture_output=True, text=True, timeout=timeout_s + 10)


# ---- against a service --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def target(toy_zip: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A service of the toy device."""
    plane = DataPlane(ModelRegistry(Decoder.load(toy_zip, threads=1), no_tracker), toy.ToySource(toy.ToyDevice()))
    with LightpageServer(plane, Recalibrator(plane, None, tmp_path_factory.mktemp("work"))) as server:
        yield server.target


def raw(path: Path, *frames: np.ndarray) -> Path:
    path.write_bytes(b"".join(frame.tobytes() for frame in frames))
    return path


def test_it_connects_with_certificates(program: Path, toy_zip: Path, tmp_path: Path) -> None:
    authority = Authority(tmp_path / "certificates")
    plane = DataPlane(ModelRegistry(Decoder.load(toy_zip, threads=1), no_tracker))
    with LightpageServer(plane, Recalibrator(plane), certificates=Certificates(authority.service())) as server:
        for roles, status, told in ((["read"], 0, "model toy toy-1"), ([], 2, "NOT_ALLOWED")):
            files = vars(authority.caller("caller", roles))
            options = [word for name, path in files.items() for word in (f"--{name}", path)]
            done = run(program, server.target, *options, "describe")
            assert (done.returncode, told in done.stdout + done.stderr) == (status, True), done.stderr


def test_it_describes_the_service(program: Path, target: str) -> None:
    done = run(program, target, "describe")
    assert done.returncode == 0, done.stderr
    assert "model toy toy-1\n" in done.stdout
    assert "camera 64x96, 8 bits\npage 16x24\n" in done.stdout


def test_it_decodes_a_pair_that_it_sends(program: Path, target: str, tmp_path: Path) -> None:
    symbols = toy.symbols_of(16, 3)[0]
    pair = toy.ToyDevice(seed=3).page(symbols, 16, 0.7)
    frames, out = raw(tmp_path / "frames.raw", pair.in_phase, pair.quadrature), tmp_path / "symbols"
    done = run(program, target, "decode", frames, "--out", out, "--levels", 16)
    assert done.returncode == 0, done.stderr
    assert out.read_bytes() == symbols.tobytes()


def test_each_client_at_a_unix_socket_has_a_session_of_its_own(program: Path, toy_zip: Path, tmp_path: Path) -> None:
    plane = DataPlane(ModelRegistry(Decoder.load(toy_zip, threads=1), no_tracker))
    pair = toy.ToyDevice(seed=3).page(toy.symbols_of(16, 3)[0], 16, 0.7)
    frames = raw(tmp_path / "frames.raw", pair.in_phase, pair.quadrature)
    with LightpageServer(plane, Recalibrator(plane), f"unix:{tmp_path}/s") as server:
        for _ in range(2):
            done = run(program, server.target, "decode", frames, "--out", tmp_path / "symbols", "--levels", 16)
            assert done.returncode == 0, done.stderr
    sessions = list(plane.registry.current.sessions._trackers)
    assert len(sessions) == 2
    assert all(session.startswith("session client ") for session in sessions)


def test_it_says_what_the_service_does_not_like(program: Path, target: str, tmp_path: Path) -> None:
    pair = toy.ToyDevice(seed=3).page(toy.symbols_of(16, 3)[0], 16, 0.7)
    swapped = raw(tmp_path / "swapped.raw", pair.quadrature, pair.in_phase)
    done = run(program, target, "decode", swapped, "--out", tmp_path / "symbols", "--levels", 16)
    assert (done.returncode, done.stdout) == (2, "")
    assert "reason FRAMES_DISAGREE, FramesDisagreeError" in done.stderr
    done = run(program, target, "decode", swapped, "--out", tmp_path / "symbols", "--levels", 999)
    assert "reason INVALID_VALUE, PageError, field levels" in done.stderr
    short = raw(tmp_path / "short.raw", pair.in_phase)
    assert "6144 bytes" in run(program, target, "decode", short, "--out", tmp_path / "symbols").stderr
    assert "no file" in run(program, target, "decode", tmp_path, "--out", tmp_path / "symbols").stderr


def test_it_recalibrates_a_service(program: Path, toy_zip: Path, tmp_path: Path) -> None:
    device = toy.ToySource(toy.ToyDevice((150.0, 62.0)))
    plane = DataPlane(ModelRegistry(Decoder.load(toy_zip, threads=1), no_tracker), device)
    with LightpageServer(plane, Recalibrator(plane, toy.fit_references, tmp_path)) as server:
        done = run(program, server.target, "recalibrate", "--pages", 2)
        assert done.returncode == 0, done.stderr
        assert plane.registry.current.version == "toy-1+r1"
        assert "toy-1+r1" in done.stdout
        again = run(program, server.target, "watch", done.stdout.split()[1])
        assert again.returncode == 0, again.stderr
        assert "toy-1+r1" in again.stdout
        assert run(program, server.target, "watch", "nobody").returncode == 2


def test_a_page_that_is_asked_for_again_is_the_same_shot(program: Path, target: str, tmp_path: Path) -> None:
    first = run(program, target, "read", 5, "--request-id", "a", "--out", tmp_path / "first")
    again = run(program, target, "read", 5, "--request-id", "a", "--out", tmp_path / "again")
    assert (first.returncode, again.returncode) == (0, 0), first.stderr + again.stderr
    assert first.stdout.splitlines()[0] == "page 5"
    assert again.stdout.splitlines()[0] == "page 5, the answer of an earlier call"
    assert (tmp_path / "first").read_bytes() == (tmp_path / "again").read_bytes() == toy.symbols_of(16, 5)[0].tobytes()
    other = run(program, target, "read", 6, "--request-id", "a")
    assert other.returncode == 2
    assert "reason REQUEST_ID" in other.stderr


@pytest.mark.parametrize("words", [[], ["fly"], ["read", "five", "--request-id", "a"], ["decode"], ["watch"]])
def test_a_wrong_command_line_is_explained(words: list[str], program: Path) -> None:
    done = run(program, "127.0.0.1:1", *words)
    assert done.returncode == 64
    assert done.stderr.startswith("usage: lightpage_example")


def test_no_service_is_an_error_at_the_deadline(program: Path) -> None:
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))  # and nobody listens
        done = run(program, f"127.0.0.1:{held.getsockname()[1]}", "describe", timeout_s=1)
    assert done.returncode == 2
    assert "status 14" in done.stderr or "status 4" in done.stderr


# ---- against services that answer as told -------------------------------------------------------------------------


def busy(context: grpc.ServicerContext, retry_s: float) -> None:
    """End a call as a service does that has too much to do."""
    delay = Duration()
    delay.FromNanoseconds(int(1e9 * retry_s))
    status = status_pb2.Status(code=grpc.StatusCode.RESOURCE_EXHAUSTED.value[0], message="too much to do")
    info = error_details_pb2.ErrorInfo(reason="OVERLOADED", domain="lightpage")
    for detail in (info, error_details_pb2.RetryInfo(retry_delay=delay)):
        packed = AnyMessage()
        packed.Pack(detail)
        status.details.append(packed)
    context.set_trailing_metadata((("grpc-status-details-bin", status.SerializeToString()),))
    context.abort(grpc.StatusCode.RESOURCE_EXHAUSTED, status.message)


class Jobs(pb_grpc.LightpageServicer):
    """One job that takes a number of steps, or goes on until it is cancelled; too much to do at first."""

    def __init__(self, steps: int | None = 3, refusals: int = 2, retry_s: float = 0.2, breaks: int = 0) -> None:
        self.steps, self.refusals, self.retry_s, self.breaks = steps, refusals, retry_s, breaks
        self.asked: list[float] = []
        self.watched = 0
        self.cancelled = threading.Event()

    def _job(self, state: pb.JobState, fraction: float = 0.0) -> pb.Job:
        job = pb.Job(id="job-1", state=state, progress=pb.Progress(step="fit", fraction=fraction))
        if state == pb.JOB_STATE_DONE:
            job.result.CopyFrom(pb.RecalibrationResult(model_version="toy-2", air_before=2.5, air_after=3.5))
        return job

    def StartRecalibration(self, request: pb.StartRecalibrationRequest, context: grpc.ServicerContext) -> pb.Job:
        self.asked.append(time.monotonic())
        if len(self.asked) <= self.refusals:
            busy(context, self.retry_s)
        assert request.source.count == 4
        return self._job(pb.JOB_STATE_RUNNING)

    def WatchJob(self, request: pb.WatchJobRequest, context: grpc.ServicerContext) -> Iterator[pb.Job]:
        assert request.id == "job-1"
        self.watched += 1
        step = 0
        while not self.cancelled.is_set() and context.is_active() and step != self.steps:
            step += 1
            yield self._job(pb.JOB_STATE_RUNNING, step / 10)
            if self.watched <= self.breaks:
                context.abort(grpc.StatusCode.UNAVAILABLE, "the connection broke")
            self.cancelled.wait(0.05)
        yield self._job(pb.JOB_STATE_CANCELLED if self.cancelled.is_set() else pb.JOB_STATE_DONE)

    def CancelJob(self, request: pb.CancelJobRequest, context: grpc.ServicerContext) -> pb.Job:
        assert request.id == "job-1"
        self.cancelled.set()
        return self._job(pb.JOB_STATE_RUNNING)


@contextmanager
def served(servicer: pb_grpc.LightpageServicer) -> Iterator[str]:
    server = grpc.server(futures.ThreadPoolExecutor(max_workers=4))
    pb_grpc.add_LightpageServicer_to_server(servicer, server)  # type: ignore[no-untyped-call]
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    yield f"127.0.0.1:{port}"
    server.stop(grace=None).wait(5)


def test_it_comes_back_when_the_service_says_and_follows_the_job(program: Path) -> None:
    jobs = Jobs()
    with served(jobs) as target:
        done = run(program, target, "recalibrate", "--pages", 4)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == [
        *(f"job job-1 RUNNING: fit {percent}%" for percent in (10, 20, 30)),
        "job job-1 DONE: model toy-2, bits a symbol 2.5 -> 3.5",
    ]
    assert len(jobs.asked) == 3
    assert np.diff(jobs.asked).min() >= jobs.retry_s


def test_it_does_not_wait_beyond_its_deadline(program: Path) -> None:
    jobs = Jobs(refusals=9, retry_s=20)
    with served(jobs) as target:
        done = run(program, target, "recalibrate", "--pages", 4, timeout_s=5)
    assert done.returncode == 2
    assert "status 8, reason OVERLOADED, again in 20 s" in done.stderr
    assert len(jobs.asked) == 1


def test_it_cancels_a_job(program: Path) -> None:
    jobs = Jobs(steps=None, refusals=0)
    with served(jobs) as target:
        done = run(program, target, "recalibrate", "--pages", 4, "--cancel-after", 0.5)
    assert done.returncode == 1, done.stderr
    assert done.stdout.splitlines()[-1] == "job job-1 CANCELLED"
    assert "cancelling job job-1\n" in done.stdout


def test_a_watch_goes_on_after_a_lost_connection(program: Path) -> None:
    jobs = Jobs(steps=1, breaks=2)
    with served(jobs) as target:
        done = run(program, target, "watch", "job-1")
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("RUNNING") == 3
    assert jobs.watched == 3


class Forgetful(pb_grpc.LightpageServicer):
    """Takes a page at once; the first two answers are lost on their way, or late where there is a delay."""

    def __init__(self, delay_s: float = 0.0) -> None:
        self.delay_s = delay_s
        self.asked: list[str] = []

    def ReadPage(self, request: pb.ReadPageRequest, context: grpc.ServicerContext) -> pb.ReadPageReply:
        self.asked.append(request.request_id)
        if len(self.asked) < 3:
            if self.delay_s:
                time.sleep(self.delay_s)
            else:
                context.abort(grpc.StatusCode.UNAVAILABLE, "the connection broke")
        return pb.ReadPageReply(page=request.page, replayed=True)


@pytest.mark.parametrize("delay_s", [0.0, 2.0])
def test_a_page_whose_answer_is_lost_or_late_is_asked_for_again_by_the_same_id(program: Path, delay_s: float) -> None:
    servicer = Forgetful(delay_s)
    with served(servicer) as target:
        done = run(program, target, "read", 7, "--request-id", "mine", "--attempt", 0.7)
    assert done.returncode == 0, done.stderr
    assert servicer.asked == ["mine"] * 3
    assert done.stdout.startswith("page 7, the answer of an earlier call\n")
