"""The console says what the service sees, acts for administrators alone, and is bounded."""

import errno
import gzip
import io
import json
import math
import os
import socket
import ssl
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import Mock
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import numpy as np
import pytest
from PIL import Image

from lightpage.cli import main as cli_main
from lightpage.cli.main import EXIT_ERROR, lightpage
from lightpage.errors import InvalidInputError, Reason
from lightpage.runtime.console.actions import Actions
from lightpage.runtime.console.application import console_routes
from lightpage.runtime.console.last_pages import LastPages
from lightpage.runtime.console.pictures import SIDE_PX, air_png, frame_png
from lightpage.runtime.console.scrapes import fetch
from lightpage.runtime.console.server import serving
from lightpage.runtime.console.state import POINTS, RECENT, ConsoleState
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.service.caller import Actor, Caller
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.jobs.recalibrator import Recalibrator
from lightpage.runtime.service.models.models import Models
from lightpage.runtime.service.monitoring.monitor import Monitor
from lightpage.runtime.service.monitoring.observation import Observation
from lightpage.runtime.service.pages.reading import read_page
from lightpage.runtime.service.server.certificates import Certificates
from tests.clock import HandClock
from tests.runtime import toy
from tests.runtime.console.stage import Stage, stage
from tests.runtime.service.server.authority import Authority
from tests.waiting import eventually


def fetched(
    url: str, method: str = "GET", context: ssl.SSLContext | None = None, content: bytes | None = None, **headers: str
) -> tuple[int, bytes, dict[str, str]]:
    try:
        with urlopen(Request(url, content, headers, method=method), timeout=60, context=context) as reply:
            return reply.status, reply.read(), dict(reply.headers)
    except HTTPError as error:
        with error:
            return error.code, error.read(), dict(error.headers)


def is_answered(running: Stage, context: ssl.SSLContext | None = None) -> bool:
    with suppress(OSError):
        return fetched(f"{running.url}/metrics", context=context)[0] == 200
    return False


def connected(running: Stage) -> socket.socket:
    return socket.create_connection(("localhost", running.port), timeout=60)


def test_the_state_is_that_of_the_pages(decoder: Decoder) -> None:
    with stage(decoder) as running:
        _, empty, _ = fetched(f"{running.url}/state.json")
        assert json.loads(empty)["condition"] == "no page yet"
        assert fetched(f"{running.url}/frames/in_phase.png")[0] == 404
        running.read(12)
        status, content, headers = fetched(f"{running.url}/state.json")
        assert (status, headers["Cache-Control"]) == (200, "no-store")
        assert "default-src 'self'" in headers["Content-Security-Policy"]
        state = json.loads(content)
        assert (state["source"], state["pages"], len(state["recent"])) == ("toy:device", 12, 12)
        assert [(loss["reason"], loss["count"]) for loss in state["losses"]] == [("MISSING_FRAME", 2)]
        assert state["recent"][2]["lost"] == "MISSING_FRAME"
        assert state["series"]["air_bits"][0] > 0
        assert (state["series"]["air_bits"][4], state["series"]["lost"][4]) == (None, "MISSING_FRAME")
        assert state["signs"]["shift_px"]["raise_at"] == 4.0
        assert [model["version"] for model in state["models"]] == ["toy-1"]
        for name in ("frames/in_phase", "frames/quadrature", "air"):
            status, picture, headers = fetched(f"{running.url}/{name}.png")
            assert (status, headers["Content-Type"]) == (200, "image/png")
            assert Image.open(io.BytesIO(picture)).size[0] >= 1


def test_metrics_are_beside_it_and_nothing_takes_orders_or_tells_of_the_inside(
    decoder: Decoder, monkeypatch: pytest.MonkeyPatch
) -> None:
    with stage(decoder) as running:
        with pytest.raises(InvalidInputError, match="in use"), serving(running.routes, running.port):
            pass
        for accepted in ("identity", "gzip"):
            _, content, headers = fetched(f"{running.url}/metrics", **{"Accept-Encoding": accepted})
            assert headers.get("Content-Encoding", "identity") == accepted
            assert b"lightpage_calls_in_flight" in (gzip.decompress(content) if accepted == "gzip" else content)
        for method in ("POST", "PUT", "DELETE"):
            assert fetched(f"{running.url}/state.json", method)[0] == 405
        for path in ("/static/console.js", "/../server.py", "//etc/passwd", "/frames/other.png"):
            assert fetched(running.url + path)[0] == 404
        for path in ("/", "/nothing"):
            status, content, headers = fetched(running.url + path)
            found, nothing, told = fetched(running.url + path, "HEAD")
            assert (found, nothing, told["Content-Type"]) == (status, b"", headers["Content-Type"])
            assert int(headers["Content-Length"]) == int(told["Content-Length"]) == len(content)
        monkeypatch.setattr(running.state, "to_json", lambda *_: 1 // 0)
        status, content, headers = fetched(f"{running.url}/state.json")
        assert (status, content, headers["Server"]) == (500, b"see the log\n", "lightpage")


def test_what_is_no_number_is_none_and_pages_are_bounded_and_thinned(decoder: Decoder) -> None:
    page = decoder.decode(toy.ToyDevice().page(toy.symbols_of(16, 1)[0], 16, 0.5), 16)
    page = replace(page, piston_rad=math.nan, check=replace(page.check, confirmed_bits=math.inf))
    last_pages, registry = LastPages(pages=2 * POINTS), Models(decoder)
    for number in range(3 * POINTS):
        last_pages.observe(Observation("page", number, "toy-1", float(number), 0.1, page=page))
    state = ConsoleState(last_pages, registry, Monitor(), "toy").to_json()
    times = [*map(float, range(POINTS, 3 * POINTS, 2)), 3 * POINTS - 1]
    assert (state["series"]["time_s"], state["pages"]) == (times, 3 * POINTS)
    assert state["series"]["piston_rad"][-1] is state["series"]["share"][-1] is None
    assert [row["page_index"] for row in state["recent"]] == list(range(3 * POINTS))[: -RECENT - 1 : -1]
    json.dumps(state, allow_nan=False)


def test_the_condition_is_that_of_the_last_pages(decoder: Decoder) -> None:
    clock, last_pages, monitor = HandClock(1e9), LastPages(), Monitor()
    state = ConsoleState(last_pages, Models(decoder), monitor, "toy", clock=clock.now)
    told = list[str]()

    def seen(*lost: Reason | None) -> None:
        for each in lost:
            last_pages.observe(Observation("page", 1, "toy-1", clock.now(), 0.1, each))
        told.append(state.to_json()["condition"])

    for lost in ((), (None,), (Reason.MISSING_FRAME, None, None, None, None), (None,)):
        seen(*lost)
    for later_s in (30.0, 0.1):
        clock.advance(later_s)
        seen()
    for _ in range(8):
        monitor.follow("toy-1", {"unread": 1.0})
    seen()
    expected = ["no page yet", "reading", "pages are being lost", "reading", "reading", "idle", "recalibration is due"]
    assert told == expected
    assert state.to_json()["uptime_s"] == pytest.approx(30.1)


def test_pictures_are_thinned_brightened_and_show_saturation_and_what_falls_below_the_usual() -> None:
    frame = np.zeros((2000, 3000), np.uint16)
    frame[::4, ::4] = 4095
    picture = np.asarray(Image.open(io.BytesIO(frame_png(frame, 12))))
    assert max(picture.shape) <= SIDE_PX
    assert tuple(picture[0, 0]) == (230, 60, 30)
    dark, dim = (np.asarray(Image.open(io.BytesIO(frame_png(np.full((9, 9), n, np.uint16), 12)))) for n in (4, 400))
    assert (dark.max() < 10, dim.min() > 250) == (True, True)
    grid = np.asarray(Image.open(io.BytesIO(air_png(np.linspace(0, 1000, 12).reshape(3, 4), usual=5.0))))
    assert grid.shape == (3 * 80, 4 * 80, 3)
    assert grid[0, 0, 0] > 160 > grid[-1, -1, 0], "red below the usual, blue at it"


def test_the_command_finds_a_console_or_says_what_it_lacks(
    decoder: Decoder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shown = tmp_path / "J"

    def found(running: Stage) -> str:
        command = ["console", "--address", running.url.partition("://")[2], "--no-browser", "--json", str(shown)]
        status = cli_main.run(lightpage, command)
        out, err = capsys.readouterr()
        assert status == (0 if out else EXIT_ERROR)
        return out.strip() or err

    with stage(decoder) as running:
        assert found(running) == f"{running.url}/"
        assert json.loads(shown.read_text())["state"]["condition"] == "no page yet"
    assert running.url.removeprefix("http://") in found(running)
    with stage(decoder, Authority(tmp_path).service()) as running:
        assert "--certificate" in found(running)


def status_of_host(port: int, host: str | None, path: str = "/state.json", method: str = "GET") -> int:
    with socket.create_connection(("localhost", port), timeout=60) as connection:
        named = "" if host is None else f"Host: {host}\r\n"
        connection.sendall(f"{method} {path} HTTP/1.0\r\n{named}\r\n".encode())
        return int(connection.recv(1000).split()[1])


def test_a_name_that_a_stranger_made_resolve_to_this_machine_reads_nothing(decoder: Decoder) -> None:
    with stage(decoder) as running:
        for host in (f"127.0.0.1:{running.port}", "localhost", "[::1]", socket.gethostname(), None):
            assert status_of_host(running.port, host) == 200, host
        for path in ("/", "/metrics", "/frames/in_phase.png", "/console.js"):
            assert status_of_host(running.port, "rebound.example", path) == 421
        assert status_of_host(running.port, "rebound.example", "/actions", "POST") == 421
        with serving(running.routes, 0, names=("Device.example",)) as port:
            assert status_of_host(port, "device.example") == 200
            assert status_of_host(port, "other.example") == 421


def test_metrics_are_shown_on_ipv6(decoder: Decoder) -> None:
    if not socket.has_ipv6:
        pytest.skip("no IPv6")
    with stage(decoder) as running:
        for host, asked in (("::1", "[::1]"), ("[::]", "[::1]"), ("[::]", "127.0.0.1")):  # the latter as gRPC's
            with serving(running.routes, 0, host) as port:
                assert fetch("metrics", f"{asked}:{port}", "metrics").startswith(b"# HELP")
        with pytest.raises(InvalidInputError), serving(running.routes, 0, "a" * 64):
            pass


def test_callers_that_say_nothing_or_hang_up_hold_up_nobody(
    decoder: Decoder, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    authority, foreign = Authority(tmp_path), Authority(tmp_path / "foreign")
    strangers = authority.caller("nobody"), replace(foreign.caller("o", ["admin"]), ca=tmp_path / "ca.pem")
    context, *others = (of.client_context() for of in (authority.caller("watcher", ["read"]), *strangers))
    with stage(decoder, authority.service()) as running, connected(running):
        assert is_answered(running, context)
        assert not any(is_answered(running, other) for other in others)
        with context.wrap_socket(connected(running), server_hostname="localhost") as hung_up:
            hung_up.sendall(b"GET /metrics HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert is_answered(running, context)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("request_line", ["POST /actions", "POST /", "GET /metrics", "HEAD /"])
@pytest.mark.parametrize(("length", "status"), [(100, b" 408 "), (100_000, b" 413 ")])
def test_a_body_that_does_not_come_or_is_too_large_is_refused_and_nothing_else_is_said(
    request_line: str,
    length: int,
    status: bytes,
    decoder: Decoder,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("lightpage.runtime.console.server.SILENCE_S", 0.1)
    with stage(decoder) as running, connected(running) as connection:
        connection.settimeout(20.0)  # an end of `LONGEST_S` comes later
        connection.sendall(f"{request_line} HTTP/1.1\r\nHost: localhost\r\nContent-Length: {length}\r\n\r\nx".encode())
        assert status in connection.recv(1000)
    assert capfd.readouterr().err == ""


def test_connections_are_bounded_in_number_and_in_time(decoder: Decoder, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lightpage.runtime.console.server.MOST_CONNECTIONS", 3)
    monkeypatch.setattr("lightpage.runtime.console.server.LONGEST_S", 0.5)
    with stage(decoder) as running:
        silent = [connected(running) for _ in range(3)]
        with connected(running) as late:
            assert late.recv(1) == b"", "there is no room for a fourth one"
        for connection in silent:
            assert connection.recv(1) == b"", "it was held for long enough"
            connection.close()
        assert eventually(lambda: is_answered(running))


def test_an_answer_that_hangs_holds_up_no_stop(decoder: Decoder, monkeypatch: pytest.MonkeyPatch) -> None:
    begun, go, ended = threading.Event(), threading.Event(), list[bool]()
    with stage(decoder) as running, connected(running) as waiting:
        monkeypatch.setattr(running.state, "to_json", lambda *_: (begun.set(), ended.append(go.wait(20))))
        waiting.sendall(b"GET /state.json HTTP/1.0\r\n\r\n")
        assert begun.wait(60)
        running.close()
        assert (ended, waiting.recv(1)) == ([], b"")
    go.set()


@pytest.mark.parametrize(("number", "pause_s"), [(errno.EMFILE, 0.1), (errno.EPERM, 200.0)])
def test_where_there_is_no_descriptor_callers_wait_and_whatever_else_fails_holds_up_nobody(
    number: int, pause_s: float, decoder: Decoder, monkeypatch: pytest.MonkeyPatch
) -> None:
    accepting, accept = socket.socket.accept, Mock(side_effect=OSError(number, os.strerror(number)))
    monkeypatch.setattr("lightpage.runtime.console.server.PAUSE_S", pause_s)
    with stage(decoder) as running:
        monkeypatch.setattr("socket.socket.accept", accept)
        with connected(running) as waiting:
            assert eventually(lambda: accept.call_count > 1)
            monkeypatch.setattr("socket.socket.accept", accepting)
            waiting.sendall(b"GET /metrics HTTP/1.0\r\n\r\n")
            assert b" 200 " in waiting.recv(1000)


def test_new_certificates_count_from_the_next_connection_on(decoder: Decoder, tmp_path: Path) -> None:
    before, after = Authority(tmp_path / "before"), Authority(tmp_path / "after")
    contexts = [each.caller("watcher", ["read"]).client_context() for each in (before, after)]
    with stage(decoder, before.service()) as running:
        assert [is_answered(running, context) for context in contexts] == [True, False]
        after.service()
        for name in ("ca.pem", "service.pem", "service.key"):
            os.replace(after.folder / name, before.folder / name)
        assert [is_answered(running, context) for context in contexts] == [False, True]


ROLL_BACK = {"action": "roll back", "expected": "toy-2"}


class Asked:
    """A console with TLS of a service that has an earlier model."""

    def __init__(self, decoder: Decoder, folder: Path, stack: ExitStack) -> None:
        self.source, self.clock = toy.ToySource(toy.ToyDevice()), HandClock(time.time())
        self.plane = DataPlane(Models(decoder), self.source)
        self.plane.models.adopt(Decoder.load(toy.write_toy_bundle(folder / "c.zip", version="toy-2"), 1))
        self.recalibrator = Recalibrator(self.plane, toy.fit_references)
        stack.callback(self.recalibrator.close)
        monitor, actions = Monitor(), Actions(self.plane, self.recalibrator)
        state = ConsoleState(LastPages(), self.plane.models, monitor, "toy", actions, self.clock.now)
        self.routes, authority = console_routes(state, self.plane.metrics.registry), Authority(folder)
        certificates = Certificates(authority.service())
        self.port = stack.enter_context(serving(self.routes, 0, certificates=certificates, names=["device.example"]))
        self.context = cache(lambda *roles: authority.caller("operator 7", roles).client_context())

    @property
    def version(self) -> str:
        return self.plane.models.current.version

    def shown(self, path: str, *roles: str) -> tuple[int, Any]:
        """Status and content of a page; of JSON, what it holds."""
        status, content, headers = fetched(f"https://localhost:{self.port}{path}", context=self.context(*roles))
        return status, json.loads(content) if headers["Content-Type"] == "application/json" else content

    def act(self, roles: Sequence[str] = ("admin",), content: object = ROLL_BACK, **headers: str) -> tuple[int, bytes]:
        body = content if isinstance(content, bytes) else json.dumps(content).encode()
        headers = {"Host": "device.example", "Content-Type": "application/json", **headers}
        return fetched(f"https://localhost:{self.port}/actions", "POST", self.context(*roles), body, **headers)[:2]


@pytest.fixture
def asked(decoder: Decoder, tmp_path: Path) -> Iterator[Asked]:
    with ExitStack() as stack:
        yield Asked(decoder, tmp_path, stack)


def test_an_administrator_rolls_back(asked: Asked) -> None:
    _, before = asked.shown("/state.json", "admin")
    assert (before["caller"], before["actions"]) == ("operator 7", ["recalibrate", "roll back"])
    assert (asked.act()[0], asked.version) == (200, "toy-1")
    assert asked.shown("/state.json", "admin")[1]["actions"] == ["recalibrate"]
    assert asked.act()[0] == 409  # another model is in service than was expected


@pytest.mark.parametrize("pages", [(), (7, 9, 11)])
def test_an_administrator_recalibrates_with_the_calibration_pages_and_not_the_controllers_next_ones(
    pages: tuple[int, ...], asked: Asked
) -> None:
    content = json.dumps({"action": "recalibrate", "expected": "toy-2"}).encode()
    told = Actions(asked.plane, asked.recalibrator, pages).do(content, Actor("operator"))
    assert asked.recalibrator.jobs.wait_idle(60)
    job = asked.shown("/state.json", "admin")[1]["job"]
    assert job["id"] in told
    assert job["state"] in ("DONE", "REFUSED")
    assert asked.source.asked == list(pages or (0, 1))
    assert read_page(asked.plane, None, None, Caller()).shot.page_index == 0


@pytest.mark.parametrize("roles", [["read"], ["decode", "recalibrate"], []])
def test_nobody_else_does(roles: list[str], asked: Asked, caplog: pytest.LogCaptureFixture) -> None:
    assert (asked.act(roles)[0], asked.version) == (403, "toy-2")
    assert "127.0.0.1" in caplog.text
    status, state = asked.shown("/state.json", *roles)
    assert (status, not roles or state["actions"]) == ((200, []) if roles else (403, True))


def test_who_proves_nothing_does_nothing(asked: Asked) -> None:
    with serving(asked.routes, 0) as port:
        assert fetched(f"http://127.0.0.1:{port}/actions", "POST", None, json.dumps(ROLL_BACK).encode())[0] == 403
    assert asked.act()[0] == 200
    asked.clock.advance(100 * 86400.0)  # the certificate has ended since the connection began
    for path in ("/", "/state.json", "/metrics"):
        assert asked.shown(path, "admin")[0] == 403
    assert asked.act()[0] == 403


@pytest.mark.parametrize(
    ("content", "headers", "status"),
    [
        (ROLL_BACK, {"Origin": "https://device.example"}, 200),
        (ROLL_BACK, {"Origin": "https://elsewhere.example"}, 403),
        (ROLL_BACK, {"Content-Type": "text/plain"}, 415),
        (ROLL_BACK, {"Content-Type": "application/json; charset=utf-8"}, 200),
        ({"action": "roll back", "expected": "x" * 1000}, {}, 413),
        ({"action": "format", "expected": "toy-2"}, {}, 400),
        (b"", {}, 413),
    ],
)
def test_other_requests_change_nothing(content: object, headers: dict[str, str], status: int, asked: Asked) -> None:
    assert asked.act(content=content, **headers)[0] == status
    assert asked.version == ("toy-1" if status == 200 else "toy-2")
