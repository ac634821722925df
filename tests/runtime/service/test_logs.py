"""What the service logs, and what it does not; the record of model changes."""

from __future__ import annotations

import io
import json
import logging
import re
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import grpc
import pytest

from lightpage.errors import BundleError, InvalidInputError, RecalibrationRefusedError
from runtime.bundle.bundle import Bundle
from runtime.client.client import LightpageClient
from runtime.decoding.decoder import Decoder
from runtime.errors import CallerLeft, LostShotError, OverloadedError, Reason
from runtime.pb.lightpage.v1 import lightpage_pb2 as pb
from runtime.pb.lightpage.v1 import lightpage_pb2_grpc as pb_grpc
from runtime.rpc.call import Call
from runtime.rpc.call_log import CallLog
from runtime.rpc.server import LightpageServer
from runtime.service.audit import AuditLog
from runtime.service.caller import Actor, Caller
from runtime.service.dataplane import DataPlane
from runtime.service.logs import LimitedHandler, PageLog, TextFormatter, logging_to_stderr
from runtime.service.monitor import Monitor
from runtime.service.observation import Observation
from runtime.service.recalibrator import Recalibrator
from runtime.service.registry import ModelRegistry
from runtime.service.self_calibration import SelfCalibration
from runtime.service.store import ModelStore
from tests.lightpage.full_disk import full_disk
from tests.runtime import toy

_Code = grpc.StatusCode


def call(method: str = "ReadPage", correlation_id: str = "order 7") -> Call:
    return Call(method, Caller(), ThreadPoolExecutor(1), "ipv4:127.0.0.1:9", correlation_id)


@contextmanager
def json_lines(level: str = "debug", most: int = 100) -> Iterator[list[dict[str, Any]]]:
    """The lines that are logged inside; they are there when the block ends."""
    stream, lines = io.StringIO(), list[dict[str, Any]]()
    with logging_to_stderr("json", level, most, stream):
        yield lines
    lines += [json.loads(line) for line in stream.getvalue().splitlines()]


def test_a_call_is_logged_with_who_called_why_it_ended_and_how_long_it_took() -> None:
    with json_lines() as lines:
        CallLog().ended(call(), _Code.INVALID_ARGUMENT, InvalidInputError("levels", 1, "2..256"))
    (line,) = lines
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}\+00:00", line.pop("time"))
    assert 0 <= line.pop("seconds") < 1
    assert line == {
        "level": "INFO",
        "logger": "runtime.rpc.call_log",
        "message": "ReadPage: levels: got 1, wanted 2..256",
        "method": "ReadPage",
        "peer": "ipv4:127.0.0.1:9",
        "correlation_id": "order 7",
        "code": "INVALID_ARGUMENT",
        "reason": "INVALID_VALUE",
    }


@pytest.mark.parametrize(
    ("method", "code", "error", "level", "reason"),
    [
        ("ReadPage", _Code.OK, None, "DEBUG", None),
        ("WatchDisplay", _Code.CANCELLED, CallerLeft(), "DEBUG", None),
        ("ReadPage", _Code.CANCELLED, CallerLeft(), "INFO", None),
        ("ReadPage", _Code.DEADLINE_EXCEEDED, GeneratorExit(), "INFO", None),
        ("ReadPage", _Code.RESOURCE_EXHAUSTED, OverloadedError("a", 1, 2, retry_s=1.0), "WARNING", "OVERLOADED"),
        ("ReadPage", _Code.RESOURCE_EXHAUSTED, OverloadedError("a", 1, 2), "WARNING", "DEADLINE_TOO_SHORT"),
        (
            *("Recalibrate", _Code.FAILED_PRECONDITION, RecalibrationRefusedError("a", 1, 2)),
            *("WARNING", "RECALIBRATION_REFUSED"),
        ),
        ("ReadPage", _Code.INTERNAL, ValueError("odd"), "ERROR", "INTERNAL"),
    ],
)
def test_how_a_call_ends_says_how_loud_it_is(
    method: str, code: grpc.StatusCode, error: BaseException | None, level: str, reason: str | None
) -> None:
    with json_lines() as lines:
        CallLog().ended(call(method), code, error)
    (line,) = lines
    assert (line["level"], line["code"], line.get("reason")) == (level, code.name, reason)
    assert ("traceback" in line) == (level == "ERROR")


def test_only_what_nobody_foresaw_has_a_traceback() -> None:
    with json_lines() as lines:
        try:
            raise KeyError("gone")
        except KeyError as error:
            CallLog().ended(call(), _Code.INTERNAL, error)
    assert "raise KeyError" in lines[0]["traceback"]
    assert "gone" not in lines[0]["message"]


@pytest.mark.parametrize("format", ["text", "json"])
def test_a_library_that_denies_a_traceback_is_logged_without_one(format: str) -> None:
    stream = io.StringIO()
    with logging_to_stderr(format, "info", 100, stream):
        try:
            raise ValueError
        except ValueError:
            logging.getLogger("library").error("failed", exc_info=False)
    assert "failed" in stream.getvalue()
    assert "Traceback" not in stream.getvalue()


def test_a_thread_that_breaks_is_logged() -> None:
    with json_lines() as lines:
        thread = threading.Thread(target=lambda: [][0], name="odd")
        thread.start()
        thread.join(10)
    assert lines[0]["message"] == "thread odd broke"
    assert "IndexError" in lines[0]["traceback"]


def test_a_caller_cannot_write_lines_of_its_own() -> None:
    stream = io.StringIO()
    with logging_to_stderr("text", "info", 5, stream):
        error = InvalidInputError("name\n2026 ERROR root: \x1b[31mforged", "a", "b")
        CallLog().ended(call(correlation_id='x\ny="1"' + 1000 * "z"), _Code.INVALID_ARGUMENT, error)
    (line,) = stream.getvalue().splitlines()
    assert "name\\n2026 ERROR root: \\x1b[31mforged" in line
    assert ' correlation_id="x\\ny=\\"1\\"zzz' in line
    assert " reason=INVALID_VALUE " in line
    assert len(line) < 1000


def test_of_one_kind_only_so_many_lines_come_in_a_second_and_the_others_are_counted() -> None:
    seconds, stream = [0.0], io.StringIO()
    handler = LimitedHandler(stream, 3, lambda: seconds[0])
    handler.setFormatter(TextFormatter())
    log = logging.Logger("tests.limited", logging.INFO)
    log.addHandler(handler)

    def flood(count: int, method: str, reason: str) -> None:
        for number in range(count):
            log.info("call %d", number, extra={"told": {"method": method, "reason": reason}})

    flood(10, "ReadPage", "OVERLOADED")
    flood(2, "ReadPage", "STORE")
    flood(4, "Describe", "OVERLOADED")
    for number in range(5):
        log.info("something else %d", number)
    assert len(stream.getvalue().splitlines()) == 3 + 2 + 3 + 3
    seconds[0] = 1.5
    flood(1, "ReadPage", "OVERLOADED")
    last = stream.getvalue().splitlines()[-2:]
    assert "ReadPage OVERLOADED: 7 more of these were left out in 2 s left_out=7" in last[0]
    assert "call 0" in last[1]
    handler.close()
    told = stream.getvalue()
    assert "Describe OVERLOADED: 1 more of these" in told
    assert "tests.limited: something else 0: 2 more of these" in told
    assert told.count("left_out=") == 3


def test_what_was_left_out_is_told_though_nothing_else_happens() -> None:
    stream = io.StringIO()
    with logging_to_stderr("text", "info", 1, stream):
        for _ in range(4):
            logging.getLogger("tests.limited").warning("again")
        until = time.monotonic() + 10
        while "left_out=3" not in stream.getvalue() and time.monotonic() < until:
            time.sleep(0.02)
        assert "left_out=3" in stream.getvalue()


def test_lost_pages_are_logged_and_others_are_not() -> None:
    lost = Observation(
        "page 1 of toy:device", 1, "toy-1", 0.0, 0.25, Reason.MISSING_FRAME, "page 1 of toy:device: dark"
    )
    with json_lines() as lines:
        PageLog().observe(lost)
        PageLog().observe(Observation("page 2 of toy:device", 2, "toy-1", 0.0, 0.25))
    (line,) = lines
    assert (line["level"], line["reason"], line["seconds"]) == ("WARNING", "MISSING_FRAME", 0.25)
    assert line["message"] == "lost with model toy-1: page 1 of toy:device: dark"


class Losing(toy.ToySource):
    def shot(self, *arguments: Any, **named: Any) -> Any:
        raise LostShotError("page of toy:device", "no frame", "two frames", Reason.MISSING_FRAME)


class Breaking:
    """A handler that breaks."""

    def ListModels(self, request: pb.ListModelsRequest, call: Call) -> pb.ListModelsReply:
        raise ZeroDivisionError("nobody foresaw this")


class Service:
    def __init__(self, bundle: Path, store: Path, source: toy.ToySource, *more: object) -> None:
        registry = ModelRegistry(Decoder(Bundle.open(bundle), threads=1))
        models, self.file = ModelStore(store, registry.current.decoder.bundle), store / "audit.jsonl"
        self.plane = DataPlane(registry, source, models, observers=[PageLog()], audit=AuditLog(self.file))
        self.recalibrator = Recalibrator(self.plane, toy.fit_references)
        self.server = LightpageServer(self.plane, self.recalibrator, more=more).start()

    def entries(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.file.read_text("utf-8").splitlines()]


def test_calls_of_a_service_are_logged(toy_zip: Path, tmp_path: Path) -> None:
    with json_lines("info") as lines:
        service = Service(toy_zip, tmp_path, Losing(toy.ToyDevice()), Breaking())
        with grpc.insecure_channel(service.server.target) as channel:
            stub = pb_grpc.LightpageStub(channel)
            stub.Describe(pb.DescribeRequest(), timeout=10)
            for method, request in (
                (stub.ReadPage, pb.ReadPageRequest(correlation_id="order 8")),
                (stub.ListModels, pb.ListModelsRequest()),
            ):
                with pytest.raises(grpc.RpcError):
                    method(request, timeout=10)
        service.server.stop(0.5)
    by_method = {line.get("method"): line for line in lines}
    assert "Describe" not in by_method
    assert by_method["page"]["reason"] == "MISSING_FRAME"
    read = by_method["ReadPage"]
    assert (read["code"], read["reason"], read["correlation_id"]) == ("DATA_LOSS", "SHOT_LOST", "order 8")
    assert read["peer"].startswith(("ipv4:127.0.0.1:", "ipv4:127.0.0.1%3A", "ipv6:"))
    assert "traceback" not in read
    assert "ZeroDivisionError: nobody foresaw this" in by_method["ListModels"]["traceback"]


def test_every_change_of_models_is_written_down_with_who_made_it(toy_zip: Path, tmp_path: Path) -> None:
    service = Service(toy_zip, tmp_path, toy.ToySource(toy.ToyDevice()))
    try:
        with LightpageClient(service.server.target, timeout_s=20) as client:
            client.recalibrate(count=2)
        with grpc.insecure_channel(service.server.target) as channel:
            stub = pb_grpc.LightpageStub(channel)
            stub.Rollback(pb.RollbackRequest(correlation_id="shift 2"), timeout=10)
            with pytest.raises(grpc.RpcError):
                stub.Rollback(pb.RollbackRequest(correlation_id="shift 3"), timeout=10)
    finally:
        service.server.stop(0.5)
    first, second, third = service.entries()
    assert (first["what"], first["from"], first["to"], first["outcome"]) == ("recalibrate", "toy-1", "toy-1+r1", "done")
    assert first["who"].startswith(("ipv4:127.0.0.1", "ipv6:"))
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}\+00:00", first["time"])
    assert (second["what"], second["from"], second["to"]) == ("rollback", "toy-1+r1", "toy-1")
    assert second["correlation_id"] == "shift 2"
    assert (third["outcome"], third["correlation_id"], third["from"]) == ("failed", "shift 3", "toy-1")
    assert "an earlier model to go back to" in third["detail"]


def test_self_calibration_signs_its_changes(toy_zip: Path, tmp_path: Path) -> None:
    service = Service(toy_zip, tmp_path, toy.ToySource(toy.ToyDevice()))
    try:
        loop = SelfCalibration(service.plane, Monitor(), service.recalibrator)
        loop._recalibrated()
    finally:
        service.server.stop(0.5)
    assert [entry["who"] for entry in service.entries()] == ["self-calibration"]


def test_the_record_is_put_aside_when_it_is_large_and_only_so_many_stay(tmp_path: Path) -> None:
    file = tmp_path / "deep" / "audit.jsonl"
    for number in range(40):
        AuditLog(file, 1000, 3).record("activate", f"a{number}", "b", actor=Actor("ipv4:1", f"é{number}"))
    names = sorted(path.name for path in file.parent.iterdir())
    assert names == ["audit.jsonl", "audit.jsonl.1", "audit.jsonl.2", "audit.jsonl.3"]
    assert all(path.stat().st_size <= 1000 for path in file.parent.iterdir())
    newest_last = [file.with_name(name) for name in (*reversed(names[1:]), names[0])]
    entries = [json.loads(line) for path in newest_last for line in path.read_text("utf-8").splitlines()]
    numbers = [int(entry["from"][1:]) for entry in entries]
    assert numbers == list(range(numbers[0], 40))
    assert entries[-1]["correlation_id"] == "é39"


def test_a_full_disk_is_logged_and_leaves_whole_lines(tmp_path: Path) -> None:
    audit = AuditLog(tmp_path / "audit.jsonl")
    audit.record("activate", "a", "b")
    with json_lines() as lines, full_disk((tmp_path / "audit.jsonl").stat().st_size + 20):
        audit.record("activate", "b", "c")
    audit.record("activate", "c", "d")
    assert any("not written down" in line["message"] and line["level"] == "WARNING" for line in lines)
    assert any("activate: from b to c" in line["message"] for line in lines)
    kept = [json.loads(line)["from"] for line in (tmp_path / "audit.jsonl").read_text().splitlines()]
    assert kept == ["a", "c"]


def test_a_change_comes_about_though_it_cannot_be_written_down(toy_zip: Path, tmp_path: Path) -> None:
    registry = ModelRegistry(Decoder(Bundle.open(toy_zip), threads=1))
    (tmp_path / "file").write_text("in the way")
    plane = DataPlane(registry, audit=AuditLog(tmp_path / "file" / "audit.jsonl"))
    other = toy.write_toy_bundle(tmp_path / "other.zip", version="toy-2")
    with json_lines() as lines:
        plane.adopt(Decoder(Bundle.open(other), 1))
    assert registry.current.version == "toy-2"
    assert any("not written down" in line["message"] for line in lines)
    with pytest.raises(BundleError):
        plane.adopt(Decoder(Bundle.open(other), 1))


def test_a_folder_that_has_gone_is_not_made_again(tmp_path: Path) -> None:
    """It may be the place where a disk was mounted."""
    folder = tmp_path / "store"
    audit = AuditLog(folder / "audit.jsonl")
    folder.rename(tmp_path / "away")
    with json_lines() as lines:
        audit.record("activate", "a", "b")
    assert not folder.exists()
    assert any("not written down" in line["message"] for line in lines)


def test_changes_at_once_are_written_down_whole(tmp_path: Path) -> None:
    audit = AuditLog(tmp_path / "audit.jsonl", 5000, 50)

    def change(name: str) -> None:
        for _ in range(20):
            audit.record("pin", name, name)

    threads = [threading.Thread(target=change, args=(str(number),)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30)
    entries = [json.loads(line) for path in tmp_path.iterdir() for line in path.read_text().splitlines()]
    assert len(entries) == 80
