"""The console's actions: for administrators alone, and never in their name by a page of somebody else's."""

from __future__ import annotations

import errno
import http.client
import json
import socket
import ssl
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

from runtime.acquisition.source import Shot
from runtime.bundle.bundle import Bundle
from runtime.console.actions import Actions
from runtime.decoding.decoder import Decoder
from runtime.identity.roles import Identity, Role
from runtime.service.caller import Actor, Caller
from runtime.service.dataplane import DataPlane
from runtime.service.recalibrator import Recalibrator
from runtime.service.registry import ModelRegistry
from runtime.wire.tls import TlsFiles
from tests.runtime import toy
from tests.runtime.console.stage import Stage, stage
from tests.runtime.identity.authority import Authority

ROLL_BACK = {"action": "roll back", "expected": "toy-2"}


@pytest.fixture
def authority(tmp_path: Path) -> Authority:
    return Authority(tmp_path / "certificates")


@pytest.fixture
def secured(toy_zip: Path, authority: Authority, tmp_path: Path) -> Iterator[Stage]:
    """A console with TLS, of a service that has an earlier model."""
    with stage(toy_zip, authority.service()) as running:
        other = toy.write_toy_bundle(tmp_path / "c.zip", version="toy-2")
        running.plane.adopt(running.plane.registry.opened(other))
        yield running


def asked(
    running: Stage, tls: TlsFiles, path: str = "/actions", content: object = ROLL_BACK, **headers: str
) -> tuple[int, str]:
    """Status and text of an answer to a POST; to a GET where there is no content."""
    context = ssl.create_default_context(cafile=str(tls.ca))
    context.load_cert_chain(tls.certificate, tls.key)
    connection = http.client.HTTPSConnection("localhost", running.server.port, timeout=20, context=context)
    try:
        told = {"Content-Type": "application/json"} | {name.replace("_", "-"): value for name, value in headers.items()}
        body = None if content is None else json.dumps(content).encode()
        connection.request("GET" if content is None else "POST", path, body, told)
        reply = connection.getresponse()
        return reply.status, reply.read().decode()
    finally:
        connection.close()


def state(running: Stage, tls: TlsFiles) -> dict[str, object]:
    status, text = asked(running, tls, "/state.json", None)
    assert status == 200
    return dict(json.loads(text))


def until_answered(running: Stage) -> bool:
    """Whether somebody is answered again, once the threads of others have ended."""
    until = time.monotonic() + 10
    while time.monotonic() < until:
        try:
            with urllib.request.urlopen(f"{running.url}/metrics", timeout=10) as reply:
                return bool(reply.status == 200)
        except OSError:
            time.sleep(0.01)
    return False


def test_an_administrator_rolls_back(secured: Stage, authority: Authority) -> None:
    tls = authority.caller("operator 7", ["admin"])
    before = state(secured, tls)
    assert (before["caller"], before["actions"]) == ("operator 7", ["recalibrate", "roll back"])
    assert asked(secured, tls) == (200, "toy-1 is in service again, toy-2 is not\n")
    assert secured.plane.registry.current.version == "toy-1"
    assert state(secured, tls)["actions"] == ["recalibrate"]
    status, text = asked(secured, tls)
    assert (status, "toy-1" in text) == (409, True), "another model is in service than was expected"


def test_an_administrator_recalibrates(secured: Stage, authority: Authority) -> None:
    tls = authority.caller("operator 7", ["admin"])
    status, text = asked(secured, tls, content={"action": "recalibrate", "expected": "toy-2"})
    assert (status, text.startswith("job ")) == (200, True)
    until = time.monotonic() + 20
    while (job := state(secured, tls)["job"]) and job["state"] == "RUNNING" and time.monotonic() < until:  # type: ignore[index]
        time.sleep(0.05)
    assert isinstance(job, dict)
    assert job["id"] in text
    assert job["state"] in ("DONE", "REFUSED", "FAILED")


@pytest.mark.parametrize("roles", [("read",), ("decode", "recalibrate"), ()])
def test_nobody_else_does(secured: Stage, authority: Authority, roles: tuple[str, ...]) -> None:
    tls = authority.caller("other", roles)
    status, text = asked(secured, tls)
    assert (status, "urn:lightpage:role:admin" in text) == (403, True)
    assert secured.plane.registry.current.version == "toy-2"
    if roles:
        assert state(secured, tls)["actions"] == []
    else:
        assert asked(secured, tls, "/state.json", None)[0] == 403


def test_without_tls_there_are_no_actions(toy_zip: Path) -> None:
    with stage(toy_zip) as running:
        connection = http.client.HTTPConnection("localhost", running.server.port, timeout=20)
        connection.request("POST", "/actions", json.dumps(ROLL_BACK).encode(), {"Content-Type": "application/json"})
        reply = connection.getresponse()
        assert (reply.status, b"need TLS" in reply.read()) == (403, True)
        connection.close()


@pytest.mark.parametrize(
    ("content", "headers", "status"),
    [
        (ROLL_BACK, {"Origin": "https://elsewhere.example"}, 403),
        (ROLL_BACK, {"Origin": "null"}, 403),
        (ROLL_BACK, {"Content_Type": "text/plain"}, 415),
        (ROLL_BACK, {"Content_Type": "application/x-www-form-urlencoded"}, 415),
        ({"action": "roll back", "expected": "x" * 2000}, {}, 413),
        ({"action": "roll back"}, {}, 400),
        ({"action": "format", "expected": "toy-2"}, {}, 400),
        ({"action": ["roll back"], "expected": "toy-2"}, {}, 400),
        ({"action": "roll back", "expected": ""}, {}, 400),
        ({"action": "roll back", "expected": "\ud800"}, {}, 400),
        ("roll back", {}, 400),
    ],
)
def test_other_requests_change_nothing(
    secured: Stage, authority: Authority, content: object, headers: dict[str, str], status: int
) -> None:
    assert asked(secured, authority.caller("operator 7", ["admin"]), content=content, **headers)[0] == status
    assert secured.plane.registry.current.version == "toy-2"


def test_a_caller_who_says_nothing_holds_up_nobody(secured: Stage, authority: Authority) -> None:
    with socket.create_connection(("localhost", secured.server.port)):
        assert asked(secured, authority.caller("watcher", ["read"]), "/metrics", None)[0] == 200


def test_callers_without_a_certificate_get_no_answer(secured: Stage, authority: Authority, tmp_path: Path) -> None:
    foreign = Authority(tmp_path / "foreign").caller("operator 7", ["admin"])
    wrong = TlsFiles(authority.folder / "ca.pem", foreign.certificate, foreign.key)
    with pytest.raises((ssl.SSLError, ConnectionError, http.client.HTTPException)):
        asked(secured, wrong)
    assert secured.plane.registry.current.version == "toy-2"


def test_a_certificate_that_has_ended_since_its_tls_session_began_opens_nothing(
    secured: Stage, authority: Authority, monkeypatch: pytest.MonkeyPatch
) -> None:
    tls, ended = authority.caller("operator 7", ["admin"]), Identity("operator 7", frozenset(Role), until=1.0)
    monkeypatch.setattr("runtime.console.server.identity_of", lambda _: ended)
    for path, content in (("/", None), ("/state.json", None), ("/metrics", None), ("/actions", ROLL_BACK)):
        status, text = asked(secured, tls, path, content)
        assert (status, "operator 7 that has expired" in text) == (403, True), path
    assert secured.plane.registry.current.version == "toy-2"


def test_a_body_that_does_not_come_is_refused_and_nothing_else_is_said(
    toy_zip: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("runtime.console.server._Handler.timeout", 0.2)
    with stage(toy_zip) as running, socket.create_connection(("localhost", running.server.port)) as connection:
        connection.sendall(b"POST /actions HTTP/1.1\r\nContent-Length: 100\r\n\r\nx")
        assert b"408 Request Timeout" in connection.recv(1000)
    assert capfd.readouterr().err == ""


def test_nested_json_is_bad_json(secured: Stage, authority: Authority) -> None:
    tls = authority.caller("operator 7", ["admin"])
    context = ssl.create_default_context(cafile=str(tls.ca))
    context.load_cert_chain(tls.certificate, tls.key)
    connection = http.client.HTTPSConnection("localhost", secured.server.port, timeout=20, context=context)
    connection.request("POST", "/actions", b"[" * 999, {"Content-Type": "application/json"})
    assert connection.getresponse().status == 400
    connection.close()


def test_connections_are_bounded_in_number_and_in_time(toy_zip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("runtime.console.server.MOST_CONNECTIONS", 3)
    monkeypatch.setattr("runtime.console.server.LONGEST_S", 0.5)
    with stage(toy_zip) as running:
        place = ("localhost", running.server.port)
        silent = [socket.create_connection(place) for _ in range(3)]
        with socket.create_connection(place) as late:
            late.settimeout(10)
            assert late.recv(1) == b"", "there is no room for a fourth one"
        for connection in silent:
            connection.settimeout(10)
            assert connection.recv(1) == b"", "it was held for long enough"
            connection.close()
        assert until_answered(running)


@pytest.mark.parametrize(
    ("lacking", "error"),
    [
        ("threading.Timer.start", RuntimeError("can't start new thread")),
        ("socket.socket.dup", OSError(errno.EMFILE, "Too many open files")),
    ],
)
def test_a_connection_that_cannot_be_answered_gives_its_room_back(
    toy_zip: Path, monkeypatch: pytest.MonkeyPatch, lacking: str, error: Exception
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr("runtime.console.server.MOST_CONNECTIONS", 1)
    with stage(toy_zip) as running:
        with monkeypatch.context() as patch:
            patch.setattr(lacking, fail)
            with socket.create_connection(("localhost", running.server.port)) as connection:
                connection.settimeout(10)
                assert connection.recv(1) == b""
        assert until_answered(running)


def test_a_caller_that_hangs_up_is_no_fault(
    secured: Stage, authority: Authority, capfd: pytest.CaptureFixture[str]
) -> None:
    tls = authority.caller("watcher", ["read"])
    context = ssl.create_default_context(cafile=str(tls.ca))
    context.load_cert_chain(tls.certificate, tls.key)
    for _ in range(5):
        raw = socket.create_connection(("localhost", secured.server.port))
        with context.wrap_socket(raw, server_hostname="localhost") as connection:
            connection.sendall(b"GET /metrics HTTP/1.1\r\n\r\n")
    assert asked(secured, tls, "/metrics", None)[0] == 200
    assert capfd.readouterr().err == ""


class Numbered(toy.ToySource):
    """Notes which pages are asked for; None stands for the next one."""

    def __init__(self) -> None:
        super().__init__(toy.ToyDevice())
        self.asked: list[int | None] = []

    def shot(self, timeout_s: float = 1.0, page: int | None = None) -> Shot:
        self.asked.append(page)
        return super().shot(timeout_s, page)


@pytest.mark.parametrize("pages", [(), (7, 9, 11)])
def test_a_recalibration_reads_the_calibration_pages_and_not_the_controllers_next_ones(
    pages: tuple[int, ...], toy_zip: Path
) -> None:
    source = Numbered()
    plane = DataPlane(ModelRegistry(Decoder(Bundle.open(toy_zip), threads=1)), source)
    recalibrator = Recalibrator(plane, toy.fit_references)
    try:
        asked = json.dumps({"action": "recalibrate", "expected": "toy-1"}).encode()
        Actions(plane, recalibrator, pages).do(asked, Actor("operator"))
        assert recalibrator.jobs.wait_idle(20)
        assert source.asked == list(pages or (0, 1))
        assert plane.read_page(None, None, Caller()).shot.page_index == 0
    finally:
        recalibrator.close()
