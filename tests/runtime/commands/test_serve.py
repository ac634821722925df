"""`lightpage serve`: its settings, its log and record of model changes, what it refuses, how it ends; its health."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import tomllib
from concurrent import futures
from pathlib import Path

import grpc
import pytest
from click.testing import CliRunner
from grpc_health.v1 import health, health_pb2, health_pb2_grpc

from lightpage.cli import main as cli_main
from lightpage.cli.main import lightpage
from lightpage.errors import StoreError, UnconfirmedPageError
from lightpage.recording.reader import Recording
from lightpage.runtime.client.client import LightpageClient
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2_grpc as pb_grpc
from lightpage.runtime.commands.service.ending import leave_the_rest, stop_signals
from lightpage.runtime.commands.service.healthcheck import is_serving
from lightpage.runtime.commands.service.healthcheck import main as healthcheck
from lightpage.runtime.commands.service.serve import serve
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.service.models.models import Models
from lightpage.runtime.service.models.store import Store
from tests.runtime import toy

ROOT = Path(__file__).resolve().parents[3]


def printed(*arguments: str | Path, **environment: str) -> str:
    words = [*map(str, arguments), "--print-config"]
    return CliRunner().invoke(serve, words, env=environment, standalone_mode=False, catch_exceptions=False).output


def test_every_option_is_above_the_environment_and_printed_settings_open_nothing(tmp_path: Path) -> None:
    environment = {"BUNDLE": "other", "STORE": "other", "THREADS": "1", "TRACKING": "true", "ADDRESS": "127.0.0.1:1"}
    options = f"""--bundle b.zip --source recording:a --pages p.h5 --address 127.0.0.1:7 --store {tmp_path}/s
        --recordings . --threads 3 --steps 2 --no-tracking --metrics-port 9 --metrics-host 127.0.0.2 --self-calibrate
        --flight-recorder f --flight-recorder-pages 9"""
    text = printed(*options.split(), **{f"LIGHTPAGE_SERVICE__{name}": value for name, value in environment.items()})
    told = tomllib.loads(text)
    service = {"bundle": "b.zip", "source": "recording:a", "pages": "p.h5", "address": "127.0.0.1:7"}
    service |= {"store": f"{tmp_path}/s", "recordings": ".", "threads": 3, "steps": 2, "tracking": False}
    for table, expected in (
        ("service", service),
        ("metrics", {"port": 9, "host": "127.0.0.2"}),
        ("self_calibration", {"enabled": True}),
        ("flight_recorder", {"folder": "f", "pages": 9}),
    ):
        assert told[table] | expected == told[table]
    assert "port = 9  # option --metrics-port" in text.splitlines()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ("--self-calibrate", "--self-calibrate"),
        ("--source simulator:bench --calibration-page 1", "--calibration-page"),
        ("--incoming {folder}", "--incoming"),
        ("--steps 0", "--steps"),
    ],
)
def test_what_cannot_work_is_refused_at_once(
    options: str, named: str, toy_zip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["serve", "--bundle", str(toy_zip), *options.format(folder=tmp_path).split()]
    assert cli_main.run(lightpage, words) == 2
    out, err = capsys.readouterr()
    assert (out, len(err.splitlines()), named in err) == ("", 1, True)


class Served:
    """`lightpage serve` in a process of its own."""

    def __init__(self, *arguments: str | Path) -> None:
        command = [sys.executable, "-u", "-m", "lightpage.cli.main", "serve", "--address", "127.0.0.1:0"]
        self.process = subprocess.Popen(
            [*command, *map(str, arguments)], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )

    def target(self) -> str:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if found := re.search(r"serving .* at (\S+)", line):
                return found[1]
        raise AssertionError(self.process.communicate(timeout=30)[1])

    def end(self, kind: signal.Signals) -> tuple[int, str, str]:
        self.process.send_signal(kind)
        out, err = self.process.communicate(timeout=30)
        return self.process.returncode, out, err


def test_a_service_keeps_to_its_limits_logs_json_and_writes_down_changes_and_lost_pages(
    toy_zip: Path, decoder: Decoder, tmp_path: Path
) -> None:
    with Store(tmp_path / "store", decoder.bundle) as store:
        toy.write_toy_bundle(store.folder.bundle("toy-1+r1"), version="toy-1+r1")
        Models(decoder, store).activate("toy-1+r1")
    toy.write_toy_recording(tmp_path / "lost.h5", toy.ToyDevice((60.0, 170.0)), 16, 4)
    file = tmp_path / "service.toml"
    file.write_text(
        f"[service]\nbundle = '{toy_zip}'\nstore = '{tmp_path}/store'\nsource = 'recording:{tmp_path}/lost.h5'\n"
        "[inference]\nenabled = false\n[limits]\nrange_pages = 7\nchunk_bytes = 65536\n"
        "[logs]\nformat = 'json'\nlines_per_second = 1\n"
        f"[flight_recorder]\nfolder = '{tmp_path}/flight'\npages = 2\n[self_calibration]\npages = [2, 3]\n"
    )
    served = Served("--config", file, "--metrics-port", "0")
    try:
        target = served.target()
        with pytest.raises(StoreError):
            Store(tmp_path / "store", decoder.bundle)
        with LightpageClient(target, timeout_s=60) as client:
            assert client.describe().model.version == "toy-1+r1"
            for page in range(3):
                with pytest.raises(UnconfirmedPageError):
                    client.pages.read(page)
            symbols = toy.symbols_of(16, 5)[0]
            assert (client.frames.decode(toy.ToyDevice().page(symbols, 16), 16).symbols == symbols).mean() > 0.9
        with grpc.insecure_channel(target) as channel:
            stub = pb_grpc.LightpageStub(channel)
            assert stub.Describe(pb.DescribeRequest(), timeout=60).limits.chunk_bytes == 65536
            with pytest.raises(grpc.RpcError) as unknown:
                channel.unary_unary("/inference.GRPCInferenceService/ServerLive")(b"", timeout=60)
            assert unknown.value.code() is grpc.StatusCode.UNIMPLEMENTED
            stub.Rollback(pb.RollbackRequest(correlation_id="shift 2"), timeout=60)
            for number in range(8):
                with pytest.raises(grpc.RpcError, match="at most 7"):
                    list(stub.ReadData(pb.ReadDataRequest(pages=8 + number), timeout=60))
        status, out, err = served.end(signal.SIGTERM)
    finally:
        served.process.kill()
        served.process.wait()
    assert (status, "stopping" in out) == (0, True), err
    with Store(tmp_path / "store", decoder.bundle) as store:
        assert store.contents.state.history.cursor == 0
    lines = [json.loads(line) for line in err.splitlines()]
    start = next(line for line in lines if "lightpage" in line)
    assert (start["python"], target in start["message"]) == (sys.version.split()[0], True)
    refused = [line for line in lines if line.get("method") == "ReadData"]
    assert {(line["code"], line["reason"]) for line in refused} == {("RESOURCE_EXHAUSTED", "TOO_LARGE")}
    left_out = sum(line.get("left_out", 0) for line in lines if line["message"].startswith("ReadData TOO_LARGE: "))
    assert len(refused) < 8
    assert len(refused) + left_out == 8
    # The first change was made where there was no file yet.
    before, entry = [json.loads(line) for line in (tmp_path / "store" / "audit.jsonl").read_text().splitlines()]
    assert (before["what"], before["to"]) == ("activate", "toy-1+r1")
    assert (entry["what"], entry["from"], entry["to"]) == ("rollback", "toy-1+r1", "toy-1")
    assert (entry["correlation_id"], entry["outcome"]) == ("shift 2", "done")
    kept = sorted((tmp_path / "flight").iterdir())
    assert len(kept) == 2
    with Recording.open(kept[0]) as recording:
        assert recording.pages == 1


def test_a_thread_that_does_not_end_does_not_keep_the_process(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    end, left = threading.Event(), list[int]()
    threads = [threading.current_thread()]
    threads += [threading.Thread(target=end.wait, name=name, daemon=name == "daemon") for name in ("daemon", "hung")]
    for thread in threads[1:]:
        thread.start()
    monkeypatch.setattr(threading, "enumerate", lambda: threads)
    leave_the_rest(0.05, left.append)
    assert left == [0]
    assert "while hung was" in caplog.text
    end.set()
    leave_the_rest(60.0, left.append)
    assert left == [0]


@pytest.mark.parametrize("kind", [signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("handler", [signal.SIG_DFL, signal.SIG_IGN])  # as nohup has a hangup
def test_each_signal_but_an_ignored_hangup_stops_and_leaves_the_handlers_that_were_there(
    kind: signal.Signals, handler: signal.Handlers
) -> None:
    before = signal.signal(kind, handler)
    try:
        with stop_signals() as wait_for_stop:
            os.kill(os.getpid(), kind)
            if (kind, handler) == (signal.SIGHUP, signal.SIG_IGN):
                assert signal.getsignal(kind) == handler
                os.kill(os.getpid(), signal.SIGTERM)
            wait_for_stop()
        assert signal.getsignal(kind) == handler
    finally:
        signal.signal(kind, before)


def test_the_exit_code_of_the_health_probe_is_its_answer_and_silence_is_not_waited_for() -> None:
    grpc_server, servicer = grpc.server(futures.ThreadPoolExecutor(max_workers=2)), health.HealthServicer()
    health_pb2_grpc.add_HealthServicer_to_server(servicer, grpc_server)
    target, runner = f"127.0.0.1:{grpc_server.add_insecure_port('127.0.0.1:0')}", CliRunner()
    by_environment = {"LIGHTPAGE_HEALTH_TARGET": target}
    grpc_server.start()
    for status, code in (("SERVING", 0), ("NOT_SERVING", 1)):
        servicer.set("", health_pb2.HealthCheckResponse.ServingStatus.Value(status))
        assert runner.invoke(healthcheck, env=by_environment).exit_code == code
        assert is_serving(target) == (not code, f"{target}: {status}")
    assert runner.invoke(healthcheck, ["--target", target, "--service", "nobody.v1.Nothing"]).exit_code == 1
    assert "NOT_FOUND" in is_serving(target, service="nobody.v1.Nothing")[1]
    grpc_server.stop(grace=None).wait(5)
    serving, said = is_serving(target, timeout_s=2.0)
    assert (serving, "UNAVAILABLE" in said or "DEADLINE_EXCEEDED" in said) == (False, True)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        assert not is_serving(f"127.0.0.1:{silent.getsockname()[1]}", timeout_s=0.2)[0]
