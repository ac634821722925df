"""The console says what the service sees, acts for administrators alone, and is bounded."""

from __future__ import annotations

import errno
import io
import json
import math
import socket
import ssl
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import Request, urlopen
from wsgiref.util import setup_testing_defaults

import numpy as np
import pytest
from PIL import Image

from lightpage.cli import main as cli_main
from lightpage.cli.main import EXIT_ERROR, lightpage
from lightpage.errors import Reason
from lightpage.runtime.console.actions import Actions
from lightpage.runtime.console.history import History
from lightpage.runtime.console.pictures import SIDE_PX, confidence_png, frame_png
from lightpage.runtime.console.scrapes import fetch
from lightpage.runtime.console.server import IDENTITY, POINTS, RECENT, Console, ConsoleServer
from lightpage.runtime.device.acquisition.source import Shot
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.service.caller import STRANGER, Actor, Caller, Identity, Role
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.jobs.recalibrator import Recalibrator
from lightpage.runtime.service.models.models import Models
from lightpage.runtime.service.monitoring.metrics import ServiceMetrics
from lightpage.runtime.service.monitoring.monitor import Monitor
from lightpage.runtime.service.monitoring.observation import Observation
from lightpage.runtime.service.pages.reading import read_page
from tests.clock import HandClock
from tests.runtime import toy
from tests.runtime.console.stage import Stage, stage
from tests.runtime.service.server.authority import Authority
from tests.waiting import eventually


def fetched(url: str, method: str = "GET") -> tuple[int, bytes, dict[str, str]]:
    try:
        with urlopen(Request(url, method=method), timeout=60) as reply:
            return reply.status, reply.read(), dict(reply.headers)
    except HTTPError as error:
        with error:
            return error.code, error.read(), dict(error.headers)


def is_answered(running: Stage, context: ssl.SSLContext | None = None) -> bool:
    try:
        with urlopen(f"{running.url}/metrics", timeout=60, context=context) as reply:
            return bool(reply.status == 200)
    except OSError:
        return False


def connected(running: Stage) -> socket.socket:
    return socket.create_connection(("localhost", running.server.port), timeout=60)


def test_the_state_is_that_of_the_pages(decoder: Decoder) -> None:
    with stage(decoder) as running:
        _, empty, _ = fetched(f"{running.url}/state.json")
        assert json.loads(empty)["condition"] == "no page yet"
        assert fetched(f"{running.url}/frames/in_phase.png")[0] == 404
        running.read(12)
        status, content, headers = fetched(f"{running.url}/state.json")
        assert status == 200
        assert headers["Cache-Control"] == "no-store"
        assert "default-src 'self'" in headers["Content-Security-Policy"]
        state = json.loads(content)
        assert (state["source"], state["pages"], len(state["recent"])) == ("toy:device", 12, 12)
        assert [(loss["reason"], loss["count"]) for loss in state["losses"]] == [("MISSING_FRAME", 2)]
        assert state["recent"][2]["lost"] == "MISSING_FRAME"
        assert state["series"]["air_bits"][0] > 0
        assert state["series"]["air_bits"][4] is None
        assert [model["version"] for model in state["models"]] == ["toy-1"]
        for name in ("frames/in_phase", "frames/quadrature", "confidence"):
            status, picture, headers = fetched(f"{running.url}/{name}.png")
            assert (status, headers["Content-Type"]) == (200, "image/png")
            assert Image.open(io.BytesIO(picture)).size[0] >= 1


def test_metrics_are_beside_it_and_nothing_takes_orders(decoder: Decoder) -> None:
    with stage(decoder) as running:
        with pytest.raises(OSError, match="in use"):
            ConsoleServer(running.console, running.server.port)
        assert b"lightpage_calls_in_flight" in fetched(f"{running.url}/metrics")[1]
        for method in ("POST", "PUT", "DELETE"):
            assert fetched(f"{running.url}/state.json", method)[0] == 405
        for path in ("/static/console.js", "/../server.py", "//etc/passwd", "/frames/other.png"):
            assert fetched(running.url + path)[0] == 404
        for path in ("/", "/nothing"):
            status, content, headers = fetched(running.url + path)
            found, nothing, told = fetched(running.url + path, "HEAD")
            assert (found, nothing, told["Content-Type"]) == (status, b"", headers["Content-Type"])
            assert int(headers["Content-Length"]) == int(told["Content-Length"]) == len(content)


def test_what_nobody_foresaw_tells_nothing_of_the_inside(decoder: Decoder, monkeypatch: pytest.MonkeyPatch) -> None:
    with stage(decoder) as running:
        monkeypatch.setattr(running.console, "state", lambda *_: 1 // 0)
        status, content, headers = fetched(f"{running.url}/state.json")
        assert (status, content, headers["Server"]) == (500, b"see the log\n", "lightpage")


def test_what_is_no_number_is_none_and_series_are_thinned(decoder: Decoder) -> None:
    page = decoder.decode(toy.ToyDevice().page(toy.symbols_of(16, 1)[0], 16, 0.5), 16)
    page = replace(page, piston_rad=math.nan, check=replace(page.check, confirmed_bits=math.inf))
    history, registry = History(), Models(decoder)
    for number in range(3 * POINTS):
        history.observe(Observation("page", number, "toy-1", float(number), 0.1, page=page))
    state = Console(ServiceMetrics(), history, registry, Monitor(), "toy").state()
    assert state["series"]["time_s"] == [*map(float, range(0, 3 * POINTS, 3)), 3 * POINTS - 1]
    assert state["series"]["piston_rad"][-1] is state["series"]["share"][-1] is None
    assert [row["page_index"] for row in state["recent"]] == list(range(3 * POINTS))[: -RECENT - 1 : -1]
    json.dumps(state, allow_nan=False)


def test_the_condition_is_that_of_the_last_pages(decoder: Decoder) -> None:
    clock, history, monitor = HandClock(1e9), History(), Monitor()
    console = Console(ServiceMetrics(), history, Models(decoder), monitor, "toy", clock=clock.now)
    told = list[str]()

    def seen(*lost: Reason | None) -> None:
        for each in lost:
            history.observe(Observation("page", 1, "toy-1", clock.now(), 0.1, each))
        told.append(console.state()["condition"])

    for lost in ((), (None,), (Reason.MISSING_FRAME, None, None, None, None), (None,)):
        seen(*lost)
    for later_s in (30.0, 0.1):
        clock.advance(later_s)
        seen()
    for _ in range(8):
        monitor.follow("toy-1", {"unread": 1.0})
    seen()
    states = ["no page yet", "reading", "pages are being lost", "reading", "reading", "idle", "recalibration is due"]
    assert told == states
    assert console.state()["uptime_s"] == pytest.approx(30.1)


def test_the_history_is_bounded() -> None:
    history = History(pages=3)
    for number in range(5):
        history.observe(Observation(f"page {number}", number, "toy-1", float(number), 0.1))
    assert [row.page_index for row in history.rows()] == [2, 3, 4]
    assert history.pages == 5


def test_pictures_are_thinned_and_show_saturation() -> None:
    frame = np.zeros((2000, 3000), np.uint16)
    frame[::4, ::4] = 4095
    picture = np.asarray(Image.open(io.BytesIO(frame_png(frame, 12))))
    assert max(picture.shape) <= SIDE_PX
    assert tuple(picture[0, 0]) == (230, 60, 30)
    grid = np.asarray(Image.open(io.BytesIO(confidence_png(np.linspace(0, 1, 12).reshape(3, 4)))))
    assert grid.shape == (3 * 80, 4 * 80, 3)
    assert grid[-1, -1].sum() > grid[0, 0].sum()


def test_the_command_finds_a_console_or_says_what_it_lacks(
    decoder: Decoder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def found(running: Stage) -> str:
        command = ["console", "--address", running.url.partition("://")[2], "--no-browser"]
        status = cli_main.run(lightpage, command)
        out, err = capsys.readouterr()
        assert status == (0 if out else EXIT_ERROR)
        return out.strip() or err

    with stage(decoder) as running:
        assert found(running) == f"{running.url}/"
    assert running.url.removeprefix("http://") in found(running)
    with stage(decoder, Authority(tmp_path).service()) as running:
        assert "--certificate" in found(running)


def status_of_host(running: Stage, host: str | None, path: str = "/state.json", method: str = "GET") -> int:
    with connected(running) as connection:
        named = "" if host is None else f"Host: {host}\r\n"
        connection.sendall(f"{method} {path} HTTP/1.1\r\n{named}\r\n".encode())
        return int(connection.recv(1000).split()[1])


def test_a_name_that_a_stranger_made_resolve_to_this_machine_reads_nothing(decoder: Decoder) -> None:
    with stage(decoder) as running:
        for host in (f"127.0.0.1:{running.server.port}", "localhost", "[::1]", socket.gethostname(), None):
            assert status_of_host(running, host) == 200, host
        for path in ("/", "/metrics", "/frames/in_phase.png", "/console.js"):
            assert status_of_host(running, "rebound.example", path) == 421
        assert status_of_host(running, "rebound.example", "/actions", "POST") == 421
        with ConsoleServer(running.console, 0, names=("Device.example",)) as named:
            running.server.close()
            running.server = named
            assert status_of_host(running, "device.example") == 200
            assert status_of_host(running, "other.example") == 421


def test_metrics_are_shown_on_ipv6(decoder: Decoder) -> None:
    if not socket.has_ipv6:
        pytest.skip("no IPv6")
    with stage(decoder) as running:
        for host, asked in (("::1", ["[::1]"]), ("[::]", ["[::1]", "127.0.0.1"])):  # the latter as gRPC's
            with ConsoleServer(running.console, 0, host) as server:
                for name in asked:
                    assert fetch("metrics", f"{name}:{server.port}", "metrics").startswith(b"# HELP")
        with pytest.raises(OSError, match="no host"):
            ConsoleServer(running.console, 0, "a" * 64)


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
            hung_up.sendall(b"GET /metrics HTTP/1.1\r\n\r\n")
        assert is_answered(running, context)
    assert capfd.readouterr().err == ""


def test_a_body_that_does_not_come_is_refused_and_nothing_else_is_said(
    decoder: Decoder, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("lightpage.runtime.console.server.SILENCE_S", 0.1)
    with stage(decoder) as running, connected(running) as connection:
        connection.sendall(b"POST /actions HTTP/1.1\r\nContent-Length: 100\r\n\r\nx")
        assert b" 408 " in connection.recv(1000)
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


def test_a_connection_that_cannot_be_answered_gives_its_room_back(
    decoder: Decoder, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr("lightpage.runtime.console.server.MOST_CONNECTIONS", 1)
    with stage(decoder) as running:
        with monkeypatch.context() as patch:
            patch.setattr("socket.socket.dup", fail)
            with connected(running) as connection:
                assert connection.recv(1) == b""
        assert eventually(lambda: is_answered(running))


ROLL_BACK = {"action": "roll back", "expected": "toy-2"}
OPERATOR = Identity("operator 7", frozenset([Role.ADMIN]), until=2000.0)


class Numbered(toy.ToySource):
    """Notes which pages are asked for; None stands for the next one."""

    def __init__(self) -> None:
        super().__init__(toy.ToyDevice())
        self.asked: list[int | None] = []

    def shot(self, timeout_s: float = 1.0, page: int | None = None) -> Shot:
        self.asked.append(page)
        return super().shot(timeout_s, page)


class Asked:
    """A console without its server, of a service that has an earlier model."""

    def __init__(self, decoder: Decoder, folder: Path) -> None:
        self.source, self.clock = Numbered(), HandClock()
        self.plane = DataPlane(Models(decoder), self.source)
        self.plane.models.adopt(Decoder.load(toy.write_toy_bundle(folder / "c.zip", version="toy-2"), 1))
        self.recalibrator = Recalibrator(self.plane, toy.fit_references)
        actions = Actions(self.plane, self.recalibrator)
        registry, metrics = self.plane.models, self.plane.metrics
        self.console = Console(metrics, History(), registry, Monitor(), "toy", actions, self.clock.now)

    @property
    def version(self) -> str:
        return self.plane.models.current.version

    def ask(self, path: str, caller: Identity | None, content: object = None, **headers: str) -> tuple[int, str]:
        """Status and text of an answer to a POST; to a GET where there is no content."""
        body = content if isinstance(content, bytes) else json.dumps(content).encode()
        environ: dict[str, object] = {
            "REQUEST_METHOD": "GET" if content is None else "POST",
            "PATH_INFO": path,
            "HTTP_HOST": "device.example",
            "CONTENT_TYPE": "application/json",
            "CONTENT_LENGTH": str(len(body)),
            "wsgi.input": io.BytesIO(body),
            **({} if caller is None else {IDENTITY: caller}),
            **headers,
        }
        setup_testing_defaults(environ)  # type: ignore[arg-type]
        begun: list[str] = []
        answer = b"".join(self.console(environ, lambda status, *_: begun.append(status)))  # type: ignore[arg-type]
        return int(begun[0].split()[0]), answer.decode()

    def act(self, caller: Identity | None = OPERATOR, content: object = ROLL_BACK, **headers: str) -> tuple[int, str]:
        return self.ask("/actions", caller, content, **headers)


@pytest.fixture
def asked(decoder: Decoder, tmp_path: Path) -> Iterator[Asked]:
    made = Asked(decoder, tmp_path)
    yield made
    made.recalibrator.close()


def test_an_administrator_rolls_back(asked: Asked) -> None:
    before = asked.console.state(OPERATOR)
    assert (before["caller"], before["actions"]) == ("operator 7", ["recalibrate", "roll back"])
    status, told = asked.act()
    assert (status, "toy-1" in told) == (200, True)
    assert asked.version == "toy-1"
    assert asked.console.state(OPERATOR)["actions"] == ["recalibrate"]
    assert asked.act()[0] == 409  # another model is in service than was expected


@pytest.mark.parametrize("pages", [(), (7, 9, 11)])
def test_an_administrator_recalibrates_with_the_calibration_pages_and_not_the_controllers_next_ones(
    pages: tuple[int, ...], asked: Asked
) -> None:
    content = json.dumps({"action": "recalibrate", "expected": "toy-2"}).encode()
    told = Actions(asked.plane, asked.recalibrator, pages).do(content, Actor("operator"))
    assert asked.recalibrator.jobs.wait_idle(60)
    job = asked.console.state(OPERATOR)["job"]
    assert job["id"] in told
    assert job["state"] in ("DONE", "REFUSED")
    assert asked.source.asked == list(pages or (0, 1))
    assert read_page(asked.plane, None, None, Caller()).shot.page_index == 0


@pytest.mark.parametrize("roles", [[Role.READ], [Role.DECODE, Role.RECALIBRATE], []])
def test_nobody_else_does(roles: list[Role], asked: Asked) -> None:
    caller = Identity("other", frozenset(roles))
    assert asked.act(caller)[0] == 403
    assert asked.version == "toy-2"
    assert asked.ask("/state.json", caller)[0] == (200 if roles else 403)
    assert asked.console.state(caller)["actions"] == []


def test_who_proves_nothing_does_nothing(asked: Asked) -> None:
    assert asked.act(STRANGER)[0] == asked.act(None)[0] == 403
    asked.clock.advance(1000.0)  # the certificate has ended since its TLS session began
    for path in ("/", "/state.json", "/metrics"):
        assert asked.ask(path, OPERATOR)[0] == 403
    assert asked.act()[0] == 403
    assert asked.version == "toy-2"


@pytest.mark.parametrize(
    ("content", "headers", "status"),
    [
        (ROLL_BACK, {"HTTP_ORIGIN": "https://device.example"}, 200),
        (ROLL_BACK, {"HTTP_ORIGIN": "https://elsewhere.example"}, 403),
        (ROLL_BACK, {"CONTENT_TYPE": "text/plain"}, 415),
        (ROLL_BACK, {"CONTENT_TYPE": "application/json; charset=utf-8"}, 200),
        ({"action": "roll back", "expected": "x" * 1000}, {}, 413),
        ({"action": "format", "expected": "toy-2"}, {}, 400),
        ({"action": ["roll back"], "expected": "toy-2"}, {}, 400),
        ({"action": "roll back", "expected": "\ud800"}, {}, 400),
        (b"[" * 999, {}, 400),
        (b"", {}, 413),
    ],
)
def test_other_requests_change_nothing(content: object, headers: dict[str, str], status: int, asked: Asked) -> None:
    assert asked.act(content=content, **headers)[0] == status
    assert asked.version == ("toy-1" if status == 200 else "toy-2")
