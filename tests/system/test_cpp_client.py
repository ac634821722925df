"""The client in C++ compiles without a warning, and every command of its example does what it says."""

import hashlib
import shutil
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

import grpc
import pytest

from lightpage.errors import OverloadedError
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2_grpc as pb_grpc
from lightpage.runtime.client.wire.status import status_of, told, trailers
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.service.server.certificates import Certificates
from tests.runtime import toy
from tests.runtime.conftest import begun
from tests.runtime.service.server.authority import Authority
from tests.runtime.service.stage import Running, served

ROOT = Path(__file__).resolve().parents[2]
SOURCES = (*sorted((ROOT / "clients/cpp").iterdir()), ROOT / "proto/lightpage/v1/lightpage.proto")
PROGRAMS = ("cmake", "c++", "pkg-config", "protoc", "grpc_cpp_plugin")
SYMBOLS = toy.symbols_of(16, 3)[0]
PAIR = toy.ToyDevice(seed=3).page(SYMBOLS, 16, 0.7)


def lacking() -> list[str]:
    """Programs and libraries that a C++ client is made with and that are not here."""
    if missing := [name for name in PROGRAMS if shutil.which(name) is None]:
        return missing
    libraries = ("grpc++", "protobuf")
    return [name for name in libraries if subprocess.run(["pkg-config", "--exists", name], timeout=60).returncode]


def output(*command: object) -> str:
    done = subprocess.run([str(word) for word in command], capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stdout[-5000:] + done.stderr[-5000:]
    return done.stdout


@pytest.fixture(scope="module")
def program(pytestconfig: pytest.Config, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The example, compiled; pytest keeps it in its cache until its sources, the compiler or the libraries change."""
    if missing := lacking():
        pytest.skip(f"to compile C++ this lacks {', '.join(missing)}")
    made_of = [output("c++", "--version"), output("pkg-config", "--modversion", "grpc++", "protobuf")]
    made_of += [path.read_text() for path in SOURCES]
    name = f"lightpage-cpp-{hashlib.sha256('|'.join(made_of).encode()).hexdigest()[:16]}"
    cache = getattr(pytestconfig, "cache", None)
    build = tmp_path_factory.mktemp("cpp") if cache is None else cache.mkdir(name)
    made: Path = build / "lightpage_example"
    if not made.exists():  # without optimisation it is made in half the time
        for earlier in build.parent.glob("lightpage-cpp-*"):
            if earlier != build:
                shutil.rmtree(earlier)
        options = ["-DCMAKE_BUILD_TYPE=Debug", "-DCMAKE_CXX_FLAGS_DEBUG=-O0"]
        output("cmake", "-S", ROOT / "clients/cpp", "-B", build, *options)
        output("cmake", "--build", build)
    return made


def run(program: Path, target: str, *words: object, timeout_s: float = 60) -> subprocess.CompletedProcess[str]:
    command = [program, "--target", target, "--timeout", timeout_s, *words]
    return subprocess.run([str(word) for word in command], capture_output=True, text=True, timeout=120)


def succeeds(program: Path, target: str, *words: object) -> str:
    done = run(program, target, *words)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def service(decoder: Decoder) -> Iterator[Running]:
    running = begun(decoder)
    yield running
    running.end()


def raw(path: Path, pair: FramePair) -> Path:
    path.write_bytes(pair.in_phase.tobytes() + pair.quadrature.tobytes())
    return path


def test_it_describes_a_service_decodes_a_pair_that_it_sends_and_reads_a_page(
    program: Path, service: Running, tmp_path: Path
) -> None:
    described = succeeds(program, service.server.target, "describe")
    assert "model toy toy-1\n" in described
    out = tmp_path / "symbols"
    succeeds(program, service.server.target, "decode", raw(tmp_path / "frames", PAIR), "--out", out, "--levels", 16)
    assert out.read_bytes() == SYMBOLS.tobytes()
    for first in ("page 5", "page 5, the answer of an earlier call"):
        said = succeeds(program, service.server.target, "read", 5, "--request-id", "a", "--out", out)
        assert said.splitlines()[0] == first
        assert out.read_bytes() == toy.symbols_of(16, 5)[0].tobytes()


def test_it_says_what_the_service_does_not_like(program: Path, service: Running, tmp_path: Path) -> None:
    swapped = raw(tmp_path / "swapped", FramePair(PAIR.quadrature, PAIR.in_phase))
    for path, levels, said in ((swapped, 16, "FramesDisagreeError"), (swapped, 999, "levels"), (tmp_path, 16, "file")):
        done = run(program, service.server.target, "decode", path, "--out", tmp_path / "symbols", "--levels", levels)
        assert (done.returncode, done.stdout, said in done.stderr) == (2, "", True), done.stderr


def test_it_connects_with_certificates(program: Path, decoder: Decoder, tmp_path: Path) -> None:
    authority = Authority(tmp_path / "certificates")
    service = begun(decoder, certificates=Certificates(authority.service()))
    files = vars(authority.caller("caller", ["read"]))
    options = [word for name, path in files.items() for word in (f"--{name}", path)]
    assert "model toy toy-1" in succeeds(program, service.server.target, *options, "describe")
    service.end()


def test_it_recalibrates_a_service(program: Path, service: Running) -> None:
    said = succeeds(program, service.server.target, "recalibrate", "--pages", 2)
    assert service.version == "toy-1+r1"
    assert "toy-1+r1" in said
    assert "toy-1+r1" in succeeds(program, service.server.target, "watch", said.split()[1])


class Told(pb_grpc.LightpageServicer):
    """A job that breaks off or goes on until it is cancelled; a page whose first two answers are late or lost."""

    def __init__(self, *, steps: int | None = 3, refusals: int = 0, breaks: int = 0) -> None:
        self.steps, self.refusals, self.breaks = steps, refusals, breaks
        self.asked = list[str]()
        self.cancelled = threading.Event()

    def _job(self, state: pb.JobState, fraction: float = 0.0) -> pb.Job:
        job = pb.Job(id="job-1", state=state, progress=pb.Progress(step="fit", fraction=fraction))
        if state == pb.JOB_STATE_DONE:
            job.result.CopyFrom(pb.RecalibrationResult(model_version="toy-2", air_before=2.5, air_after=3.5))
        return job

    def StartRecalibration(self, request: pb.StartRecalibrationRequest, context: grpc.ServicerContext) -> pb.Job:
        self.asked.append(f"start {request.source.count}")
        if len(self.asked) <= self.refusals:
            error = OverloadedError("service", "too much to do", "less", 600 if self.refusals > 2 else 0.1)
            context.set_trailing_metadata(trailers(error))
            context.abort(status_of(error), told(error))
        return self._job(pb.JOB_STATE_RUNNING)

    def WatchJob(self, request: pb.WatchJobRequest, context: grpc.ServicerContext) -> Iterator[pb.Job]:
        self.asked.append("watch")
        step = 0
        while not self.cancelled.is_set() and context.is_active() and step != self.steps:
            step += 1
            yield self._job(pb.JOB_STATE_RUNNING, step / 10)
            if self.asked.count("watch") <= self.breaks:
                context.abort(grpc.StatusCode.UNAVAILABLE, "the connection broke")
            self.cancelled.wait(0.05)
        yield self._job(pb.JOB_STATE_CANCELLED if self.cancelled.is_set() else pb.JOB_STATE_DONE)

    def CancelJob(self, request: pb.CancelJobRequest, context: grpc.ServicerContext) -> pb.Job:
        self.cancelled.set()
        return self._job(pb.JOB_STATE_RUNNING)

    def ReadPage(self, request: pb.ReadPageRequest, context: grpc.ServicerContext) -> pb.ReadPageReply:
        self.asked.append(request.request_id)
        if len(self.asked) == 1:  # late
            given_up = threading.Event()
            context.add_callback(given_up.set)
            given_up.wait(60)
        elif len(self.asked) == 2:
            context.abort(grpc.StatusCode.UNAVAILABLE, "the connection broke")
        return pb.ReadPageReply(page=request.page, replayed=True)


def test_it_comes_back_when_the_service_says_and_follows_the_job(program: Path) -> None:
    with served(service := Told(refusals=2)) as port:
        said = succeeds(program, f"127.0.0.1:{port}", "recalibrate", "--pages", 4)
    assert said.splitlines() == [
        *(f"job job-1 RUNNING: fit {percent}%" for percent in (10, 20, 30)),
        "job job-1 DONE: model toy-2, bits a symbol 2.5 -> 3.5",
    ]
    assert service.asked == [*["start 4"] * 3, "watch"]
    with served(service := Told(refusals=3)) as port:  # later than its deadline
        assert run(program, f"127.0.0.1:{port}", "recalibrate", "--pages", 4).returncode == 2
    assert service.asked == ["start 4"]


def test_it_cancels_a_job_and_a_watch_goes_on_after_a_lost_connection(program: Path) -> None:
    with served(Told(steps=None)) as port:
        done = run(program, f"127.0.0.1:{port}", "recalibrate", "--pages", 4, "--cancel-after", 0.2)
    assert done.returncode == 1, done.stderr
    assert done.stdout.splitlines()[-1] == "job job-1 CANCELLED"
    with served(service := Told(steps=1, breaks=2)) as port:
        assert succeeds(program, f"127.0.0.1:{port}", "watch", "job-1").count("RUNNING") == 3
    assert service.asked == ["watch"] * 3


def test_a_page_whose_answer_is_late_or_lost_is_asked_for_again_by_the_same_id(program: Path) -> None:
    with served(service := Told()) as port:
        said = succeeds(program, f"127.0.0.1:{port}", "read", 7, "--request-id", "mine", "--attempt", 0.5)
    assert service.asked == ["mine"] * 3
    assert said.startswith("page 7, the answer of an earlier call\n")
