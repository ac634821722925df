"""`lightpage serve` by a file of settings, the environment and options; its log and its record of model changes."""

from __future__ import annotations

import json
import signal
import sys
import tomllib
from pathlib import Path

import grpc
import pytest
from click.testing import CliRunner, Result

from lightpage.cli import main as cli_main
from lightpage.cli.main import lightpage
from lightpage.recording.reader import Recording
from runtime.client.client import LightpageClient
from runtime.commands.serve import serve
from runtime.decoding.decoder import Decoder
from runtime.errors import StoreError, UnconfirmedPageError
from runtime.pb.lightpage.v1 import lightpage_pb2 as pb
from runtime.pb.lightpage.v1 import lightpage_pb2_grpc as pb_grpc
from runtime.service.settings import ServiceSettings
from runtime.service.store import ModelStore
from tests.runtime import toy
from tests.runtime.commands.test_commands import Served


def printed(*arguments: str | Path, **environment: str) -> Result:
    return CliRunner().invoke(
        serve, [*map(str, arguments), "--print-config"], env=environment, standalone_mode=False, catch_exceptions=False
    )


def test_settings_come_from_the_file_the_environment_and_options(tmp_path: Path) -> None:
    file = tmp_path / "service.toml"
    file.write_text("[service]\nsource = 'simulator:bench'\nthreads = 1\ntracking = false\n[limits]\nstall_s = 2.0\n")
    environment = {"LIGHTPAGE_SERVICE__THREADS": "2", "LIGHTPAGE_METRICS__PORT": "0", "LIGHTPAGE_STORE": "models"}
    pages = ("--calibration-page", "3", "--calibration-page", "4")
    result = printed("--config", file, "--metrics-port", "9100", *pages, **environment)
    settings = ServiceSettings.model_validate(tomllib.loads(result.output))
    assert settings.service.source == "simulator:bench"
    assert (settings.service.threads, settings.service.tracking) == (2, False)
    assert (settings.metrics.port, settings.limits.stall_s) == (9100, 2.0)
    assert settings.self_calibration.pages == (3, 4)
    lines = result.output.splitlines()
    assert "port = 9100  # option --metrics-port" in lines
    assert 'store = "models"  # environment LIGHTPAGE_STORE' in lines
    assert f"stall_s = 2.0  # file {file}" in lines


@pytest.mark.parametrize(
    ("option", "table", "key", "value"),
    [
        (("--bundle", "b.zip"), "service", "bundle", "b.zip"),
        (("--source", "recording:a"), "service", "source", "recording:a"),
        (("--source", "recording:a", "--pages", "p.h5"), "service", "pages", "p.h5"),
        (("--address", "127.0.0.1:7"), "service", "address", "127.0.0.1:7"),
        (("--store", "s"), "service", "store", "s"),
        (("--recordings", "."), "service", "recordings", "."),
        (("--threads", "3"), "service", "threads", 3),
        (("--no-tracking",), "service", "tracking", False),
        (("--tracking",), "service", "tracking", True),
        (("--metrics-port", "0"), "metrics", "port", 0),
        (("--metrics-host", "127.0.0.2"), "metrics", "host", "127.0.0.2"),
        (("--source", "recording:a", "--self-calibrate"), "self_calibration", "enabled", True),
        (("--no-self-calibrate",), "self_calibration", "enabled", False),
        (("--flight-recorder", "f"), "flight_recorder", "folder", "f"),
        (("--flight-recorder-pages", "9"), "flight_recorder", "pages", 9),
    ],
)
def test_every_option_is_above_the_environment(option: tuple[str, ...], table: str, key: str, value: object) -> None:
    environment = {
        "LIGHTPAGE_SERVICE__BUNDLE": "other",
        "LIGHTPAGE_SERVICE__STORE": "other",
        "LIGHTPAGE_SERVICE__THREADS": "1",
        "LIGHTPAGE_METRICS__PORT": "1",
        "LIGHTPAGE_METRICS__HOST": "127.0.0.7",
        "LIGHTPAGE_FLIGHT_RECORDER__FOLDER": "other",
        "LIGHTPAGE_FLIGHT_RECORDER__PAGES": "1",
    }
    assert tomllib.loads(printed(*option, **environment).output)[table][key] == value


def test_a_wrong_setting_ends_in_one_line_before_anything_is_opened(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "service.toml"
    file.write_text(f"[service]\nbundle = '{tmp_path}/none.zip'\nstore = '{tmp_path}/store'\n[limits]\nstal_s = 2")
    for arguments, named in (
        (["--config", str(file)], "limits.stal_s"),
        ([], "LIGHTPAGE_LIMITS__STALL_S"),
        (["--address", "nowhere"], "--address"),
    ):
        with monkeypatch.context() as patch:
            if not arguments:
                patch.setenv("LIGHTPAGE_LIMITS__STALL_S", "soon")
            assert cli_main.run(lightpage, ["serve", *arguments]) == 2
        out, err = capsys.readouterr()
        (line,) = err.splitlines()
        assert (out, named in line) == ("", True)
    assert list(tmp_path.iterdir()) == [file]


def test_printed_settings_open_nothing(tmp_path: Path) -> None:
    result = printed("--bundle", tmp_path / "none.zip", "--store", tmp_path / "store")
    assert result.exit_code == 0
    assert list(tmp_path.iterdir()) == []


def test_a_service_keeps_to_its_limits_logs_json_and_writes_down_changes_and_lost_pages(
    toy_zip: Path, decoder: Decoder, tmp_path: Path
) -> None:
    store = ModelStore(tmp_path / "store", decoder.bundle)
    store.remember(toy.write_toy_bundle(store.path_of("toy-1+r1"), version="toy-1+r1"))
    toy.write_toy_recording(tmp_path / "lost.h5", toy.ToyDevice((60.0, 170.0)), 16, 4)
    file = tmp_path / "service.toml"
    file.write_text(
        f"[service]\nbundle = '{toy_zip}'\nstore = '{tmp_path}/store'\nsource = 'recording:{tmp_path}/lost.h5'\n"
        "[inference]\nenabled = false\n[limits]\nrange_pages = 7\nchunk_bytes = 65536\n"
        "[logs]\nformat = 'json'\nlines_per_second = 1\n"
        f"[flight_recorder]\nfolder = '{tmp_path}/flight'\npages = 2\n[self_calibration]\npages = [2, 3]\n"
    )
    served = Served("--config", file)
    try:
        target = served.target()
        with pytest.raises(StoreError), store.locked():
            raise AssertionError("two at once")
        with LightpageClient(target, timeout_s=60) as client:
            assert client.describe().model.version == "toy-1+r1"
            for page in range(3):
                with pytest.raises(UnconfirmedPageError):
                    client.read_page(page)
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
        status, _, err = served.end(signal.SIGTERM)
    finally:
        served.process.kill()
        served.process.wait()
    assert status == 0, err
    lines = [json.loads(line) for line in err.splitlines()]
    start = next(line for line in lines if "lightpage" in line)
    assert (start["python"], target in start["message"]) == (sys.version.split()[0], True)
    refused = [line for line in lines if line.get("method") == "ReadData"]
    assert {(line["code"], line["reason"]) for line in refused} == {("RESOURCE_EXHAUSTED", "TOO_LARGE")}
    left_out = sum(line.get("left_out", 0) for line in lines if line["message"].startswith("ReadData TOO_LARGE: "))
    assert len(refused) < 8
    assert len(refused) + left_out == 8
    assert not any(line.get("method") == "Describe" for line in lines)
    (entry,) = [json.loads(line) for line in (tmp_path / "store" / "audit.jsonl").read_text().splitlines()]
    assert (entry["what"], entry["from"], entry["to"]) == ("rollback", "toy-1+r1", "toy-1")
    assert (entry["correlation_id"], entry["outcome"]) == ("shift 2", "done")
    kept = sorted((tmp_path / "flight").iterdir())
    assert len(kept) == 2
    with Recording.open(kept[0]) as recording:
        assert recording.pages == 1
