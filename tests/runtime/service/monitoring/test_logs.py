"""What the service logs, and what it does not; the record of model changes."""

import io
import json
import logging
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import grpc
import pytest

from lightpage.errors import BundleError, CallerLeft, InvalidInputError, OverloadedError, Reason
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.service.caller import Actor
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.jobs.recalibrator import Recalibrator
from lightpage.runtime.service.jobs.self_calibration import SelfCalibration
from lightpage.runtime.service.models.audit import AuditLog, Entry
from lightpage.runtime.service.models.models import Models
from lightpage.runtime.service.models.store import Store
from lightpage.runtime.service.monitoring import logs
from lightpage.runtime.service.monitoring.monitor import Monitor
from lightpage.runtime.service.monitoring.observation import Observation
from lightpage.runtime.service.server.call_log import log_end
from tests.clock import HandClock
from tests.lightpage.full_disk import full_disk
from tests.runtime import toy
from tests.waiting import eventually

_Code = grpc.StatusCode


def call(method: str = "ReadPage", correlation_id: str = "order 7") -> dict[str, Any]:
    return {"method": method, "peer": "ipv4:127.0.0.1:9", "correlation_id": correlation_id, "seconds": 0.5}


@contextmanager
def json_lines() -> Iterator[list[dict[str, Any]]]:
    stream, lines = io.StringIO(), list[dict[str, Any]]()
    with logs.logging_to_stderr(logs.LogSettings(format="json", level="debug", lines_per_second=100), stream):
        yield lines
    lines += [json.loads(line) for line in stream.getvalue().splitlines()]


def test_a_call_is_logged_with_who_called_why_it_ended_and_how_long_it_took() -> None:
    with json_lines() as lines:
        log_end(call(), _Code.INVALID_ARGUMENT, InvalidInputError("levels", 1, "2..256"))
    (line,) = lines
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}\+00:00", line.pop("time"))
    assert line == {
        "level": "INFO",
        "logger": "lightpage.runtime.service.server.call_log",
        "message": "ReadPage: levels: got 1, wanted 2..256",
        "method": "ReadPage",
        "peer": "ipv4:127.0.0.1:9",
        "correlation_id": "order 7",
        "seconds": 0.5,
        "code": "INVALID_ARGUMENT",
        "reason": "INVALID_VALUE",
    }


@pytest.mark.parametrize(
    ("method", "code", "error", "level", "reason"),
    [
        ("ReadPage", _Code.OK, None, "DEBUG", None),
        ("WatchDisplay", _Code.CANCELLED, CallerLeft(), "DEBUG", None),
        ("ReadPage", _Code.CANCELLED, CallerLeft(), "INFO", None),
        ("ReadPage", _Code.RESOURCE_EXHAUSTED, OverloadedError("a", 1, 2, retry_s=1.0), "WARNING", "OVERLOADED"),
        ("ReadPage", _Code.RESOURCE_EXHAUSTED, OverloadedError("a", 1, 2), "WARNING", "DEADLINE_TOO_SHORT"),
        ("ReadPage", _Code.INTERNAL, ValueError("odd"), "ERROR", "INTERNAL"),
    ],
)
def test_how_a_call_ends_says_how_loud_it_is(
    method: str, code: grpc.StatusCode, error: BaseException | None, level: str, reason: str | None
) -> None:
    with json_lines() as lines:
        log_end(call(method), code, error, is_watch=method == "WatchDisplay")
    (line,) = lines
    assert (line["level"], line["code"], line.get("reason")) == (level, code.name, reason)
    assert ("traceback" in line) == (level == "ERROR")
    assert "odd" not in line["message"]  # what nobody foresaw is not told in its own words


def test_a_library_that_denies_a_traceback_is_logged_without_one() -> None:
    with json_lines() as lines:
        logging.getLogger("library").error("failed", exc_info=False)
    assert (lines[0]["message"], "traceback" in lines[0]) == ("failed", False)


def test_a_thread_that_breaks_is_logged() -> None:
    with json_lines() as lines:
        thread = threading.Thread(target=lambda: [][0], name="odd")
        thread.start()
        thread.join()
    assert lines[0]["message"] == "thread odd broke"
    assert "IndexError" in lines[0]["traceback"]


def test_a_caller_cannot_write_lines_of_its_own() -> None:
    stream = io.StringIO()
    with logs.logging_to_stderr(logs.LogSettings(), stream):
        error = InvalidInputError("name\n2026 ERROR root: \x1b[31mforged", "a", "b")
        log_end(call(correlation_id='x\ny="1"' + 1000 * "z"), _Code.INVALID_ARGUMENT, error)
    (line,) = stream.getvalue().splitlines()
    assert "name\\n2026 ERROR root: \\x1b[31mforged" in line
    assert ' correlation_id="x\\ny=\\"1\\"zzz' in line
    assert " reason=INVALID_VALUE " in line
    assert len(line) < 1000


def test_of_one_kind_only_so_many_lines_come_in_a_second_and_the_others_are_counted() -> None:
    clock, stream = HandClock(), io.StringIO()
    handler = logs.LogHandler(logs.LogSettings(lines_per_second=3), stream, clock)
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
    clock.advance(1.5)  # what was left out is told of, whether anything is logged or not
    lines = eventually(lambda: stream.getvalue().count("left_out=") == 3 and stream.getvalue().splitlines()[11:])
    told = sorted((line.rpartition("left_out=")[2], line.split()[3]) for line in lines)
    assert told == [("1", "Describe"), ("2", "something"), ("7", "ReadPage")]
    flood(4, "ReadPage", "OVERLOADED")
    assert len(stream.getvalue().splitlines()) == 3 + 2 + 3 + 3 + 3 + 3
    handler.close()
    assert stream.getvalue().count("left_out=") == 4


def test_lost_pages_are_logged_and_others_are_not() -> None:
    lost = Observation("page 1 of toy", 1, "toy-1", 0.0, 0.25, Reason.MISSING_FRAME, "page 1 of toy: dark")
    with json_lines() as lines:
        logs.PageLog().observe(lost)
        logs.PageLog().observe(replace(lost, lost=None))
    (line,) = lines
    assert (line["level"], line["reason"], line["seconds"]) == ("WARNING", "MISSING_FRAME", 0.25)
    assert line["message"].count("page 1 of toy") == 1


def test_every_change_of_models_is_written_down_with_who_made_it(decoder: Decoder, tmp_path: Path) -> None:
    file, monitor = tmp_path / "audit.jsonl", Monitor()
    store = Store(tmp_path / "store", decoder.bundle)
    models = Models(decoder, store, audit=AuditLog(store, file))
    plane = DataPlane(models, toy.ToySource(toy.ToyDevice()), monitor=monitor)
    for _ in range(8):
        monitor.follow("toy-1", {"unread": 1.0})
    SelfCalibration(plane, monitor, Recalibrator(plane, toy.fit_references)).look()
    plane.models.rollback(actor=Actor("ipv4:127.0.0.1:9", "shift 2"))
    with pytest.raises(BundleError):
        plane.models.rollback(actor=Actor("ipv4:127.0.0.1:9", "shift 3"))
    plane.models.pin("toy-1", True, Actor("one"))
    plane.models.pin("toy-1", False, Actor("two"))
    plane.models.roll_forward(actor=Actor("three"))
    plane.models.activate("toy-1", actor=Actor("four"))
    entries = [json.loads(line) for line in file.read_text("utf-8").splitlines()]
    peer, keys = "ipv4:127.0.0.1:9", ("what", "who", "correlation_id", "from", "to", "outcome")
    assert [[entry[key] for key in keys] for entry in entries] == [
        ["recalibrate", "self-calibration", "", "toy-1", "toy-1+r1", "done"],
        ["rollback", peer, "shift 2", "toy-1+r1", "toy-1", "done"],
        ["rollback", peer, "shift 3", "toy-1", "", "failed"],
        ["pin", "one", "", "toy-1", "toy-1", "done"],
        ["unpin", "two", "", "toy-1", "toy-1", "done"],
        ["roll forward", "three", "", "toy-1", "toy-1+r1", "done"],
        ["activate", "four", "", "toy-1+r1", "toy-1", "done"],
    ]
    assert [bool(entry.get("detail")) for entry in entries].index(True) == 2
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}\+00:00", entries[0]["time"])


def test_the_record_is_put_aside_when_it_is_large_and_only_so_many_stay(decoder: Decoder, tmp_path: Path) -> None:
    file = tmp_path / "deep" / "audit.jsonl"
    with Store(None, decoder.bundle) as store:
        for number in range(40):
            AuditLog(store, file, 1000, 3).failed(Entry("activate", Actor("ipv4:1", f"é{number}"), f"a{number}", "b"))
    newest_last = [file.with_name(f"audit.jsonl{number}") for number in (".3", ".2", ".1", "")]
    assert set(file.parent.iterdir()) == set(newest_last)
    assert all(path.stat().st_size <= 1000 for path in newest_last)
    entries = [json.loads(line) for path in newest_last for line in path.read_text("utf-8").splitlines()]
    assert [entry["correlation_id"] for entry in entries] == [f"é{number}" for number in range(40)][-len(entries) :]
    assert "é39" in file.read_text("utf-8")


def test_lines_that_the_service_before_could_not_write_are_written_once(decoder: Decoder, tmp_path: Path) -> None:
    file, folder = tmp_path / "audit.jsonl", tmp_path / "store"
    for start in range(4):
        with Store(folder, decoder.bundle) as store:
            models = Models(decoder, store, audit=AuditLog(store, file))
            models.pin("toy-1", start == 1, Actor(f"{start}"))
            with pytest.raises(BundleError):
                models.rollback(actor=Actor("failed"))
            with store.transaction() as database:  # as if it had been killed before it noted what the file has
                database.execute(f"UPDATE audit SET exported = 0 WHERE number > {2 * start}")
            if start == 1:  # before that
                file.write_text("\n".join(file.read_text().splitlines()[:2]) + "\n")
            if start == 2:
                file.rename(f"{file}.1")
    lines = [*Path(f"{file}.1").read_text().splitlines(), *file.read_text().splitlines()]
    assert [json.loads(line)["who"] for line in lines] == ["0", "failed", "1", "failed", "2", "failed", "3", "failed"]


def test_a_line_that_somebody_has_moved_away_is_not_written_again(decoder: Decoder, tmp_path: Path) -> None:
    file = tmp_path / "audit.jsonl"
    for _ in range(2):
        with Store(tmp_path / "store", decoder.bundle) as store:
            models = Models(decoder, store, audit=AuditLog(store, file))
            assert not file.stat().st_size
            models.pin("toy-1", True)
        file.rename(tmp_path / "yesterday")


def test_a_change_that_cannot_be_written_down_is_logged_waits_and_leaves_whole_lines(
    decoder: Decoder, tmp_path: Path
) -> None:
    """A folder that has gone is not made again: it may be the place where a disk was mounted."""
    file = tmp_path / "elsewhere" / "audit.jsonl"
    with Store(tmp_path / "store", decoder.bundle) as store:
        audit, entries = AuditLog(store, file), [Entry("activate", Actor("one"), each, "z") for each in "abcde"]
        audit.failed(entries[0])
        with json_lines() as lines, full_disk(10):  # neither the database nor the file
            audit.failed(entries[1])
        audit.failed(entries[2])
        file.parent.rename(tmp_path / "away")
        with json_lines() as more:
            audit.failed(entries[3])
        assert not file.parent.exists()
    (tmp_path / "away").rename(file.parent)
    with Store(tmp_path / "store", decoder.bundle) as store:
        AuditLog(store, file).failed(entries[4])
        with store.transaction() as database:
            kept = [json.loads(line)["from"] for (line,) in database.execute("SELECT line FROM audit ORDER BY number")]
    assert [json.loads(line)["from"] for line in file.read_text().splitlines()] == [*"abcde"] == kept
    assert [line["level"] for line in (*lines, *more)] == ["WARNING", "INFO", "INFO", "WARNING"]
