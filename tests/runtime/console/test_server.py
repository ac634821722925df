"""The console says what the service sees, takes no orders, and is bounded."""

from __future__ import annotations

import http.client
import io
import json
import math
import socket
from dataclasses import replace
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import numpy as np
import pytest
from PIL import Image

from lightpage.cli import main as cli_main
from lightpage.cli.main import EXIT_ERROR, lightpage
from runtime.console.fetch import fetch
from runtime.console.history import History
from runtime.console.pictures import SIDE_PX, confidence_png, frame_png
from runtime.console.server import POINTS, RECENT, Console, ConsoleServer
from runtime.decoding.decoder import Decoder
from runtime.errors import Reason
from runtime.service.metrics import ServiceMetrics
from runtime.service.monitor import Monitor
from runtime.service.observation import Observation
from runtime.service.registry import ModelRegistry
from tests.clock import HandClock
from tests.runtime import toy
from tests.runtime.console.stage import Stage, stage
from tests.runtime.identity.authority import Authority


def fetched(url: str, method: str = "GET") -> tuple[int, bytes, dict[str, str]]:
    try:
        with urlopen(Request(url, method=method), timeout=60) as reply:
            return reply.status, reply.read(), dict(reply.headers)
    except HTTPError as error:
        with error:
            return error.code, error.read(), dict(error.headers)


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
        for path, kind in (("/", "text/html"), ("/console.js", "text/javascript"), ("/console.css", "text/css")):
            status, content, headers = fetched(running.url + path)
            assert (status, headers["Content-Type"].split(";")[0]) == (200, kind)
            assert b"http://" not in content.replace(b"http://www.w3.org/2000/svg", b"")
            assert b"https://" not in content


def test_metrics_are_beside_it_and_nothing_takes_orders(decoder: Decoder) -> None:
    with stage(decoder) as running:
        with pytest.raises(OSError, match="in use"):
            ConsoleServer(running.console, running.server.port)
        assert b"lightpage_calls_in_flight" in fetched(f"{running.url}/metrics")[1]
        for method in ("POST", "PUT", "DELETE"):
            assert fetched(f"{running.url}/state.json", method)[0] == 405
        for path in ("/nothing", "/static/console.js", "/../server.py", "//etc/passwd", "/frames/other.png"):
            assert fetched(running.url + path)[0] == 404
        for path in ("/", "/metrics", "/nothing"):
            status, content, headers = fetched(running.url + path)
            found, nothing, told = fetched(running.url + path, "HEAD")
            assert (found, nothing, told["Content-Type"]) == (status, b"", headers["Content-Type"])
            assert int(told["Content-Length"]) > 0
        assert int(headers["Content-Length"]) == int(told["Content-Length"]) == len(content)


def test_answers_tell_no_versions_of_what_runs_them(decoder: Decoder, monkeypatch: pytest.MonkeyPatch) -> None:
    with stage(decoder) as running:
        for path in ("/", "/metrics", "/nothing"):
            assert fetched(running.url + path)[2]["Server"] == "lightpage"
        monkeypatch.setattr(running.console, "state", lambda *_: 1 // 0)
        status, content, headers = fetched(f"{running.url}/state.json")
        assert (status, content, headers["Server"]) == (500, b"see the log\n", "lightpage")
        with socket.create_connection(("localhost", running.server.port)) as connection:
            connection.settimeout(60)
            connection.sendall(b"GET / HTTP/1.1\r\n" + 200 * b"A: b\r\n" + b"\r\n")
            told = connection.recv(1000)
        assert told.startswith(b"HTTP/1.0 431 ")
        assert b"\r\nServer: lightpage\r\n" in told


def test_what_is_no_number_is_none_and_series_are_thinned(decoder: Decoder) -> None:
    page = decoder.decode(toy.ToyDevice().page(toy.symbols_of(16, 1)[0], 16, 0.5), 16)
    page = replace(page, piston_rad=math.nan, check=replace(page.check, confirmed_bits=math.inf))
    history, registry = History(), ModelRegistry(decoder)
    for number in range(3 * POINTS):
        history.observe(Observation("page", number, "toy-1", float(number), 0.1, page=page))
    state = Console(ServiceMetrics(), history, registry, Monitor(), "toy").state()
    assert state["series"]["time_s"] == [*map(float, range(0, 3 * POINTS, 3)), 3 * POINTS - 1]
    assert state["series"]["piston_rad"][-1] is state["series"]["share"][-1] is None
    assert [row["page_index"] for row in state["recent"]] == list(range(3 * POINTS))[: -RECENT - 1 : -1]
    json.dumps(state, allow_nan=False)


def test_the_condition_is_that_of_the_last_pages(decoder: Decoder) -> None:
    clock, history, monitor = HandClock(1e9), History(), Monitor()
    console = Console(ServiceMetrics(), history, ModelRegistry(decoder), monitor, "toy", clock=clock.now)
    told = list[str]()

    def seen(*lost: Reason | None) -> None:
        for each in lost:
            history.observe(Observation("page", 1, "toy-1", clock.now(), 0.1, each))
        told.append(console.state()["condition"])

    seen()
    seen(None)
    seen(Reason.MISSING_FRAME, None, None, None, None)
    seen(None)
    clock.advance(30.0)
    seen()
    clock.advance(0.1)
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
    decoder: Decoder, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def found(url: str, *options: str) -> str:
        """Where the command finds it; what it says where it does not."""
        command = ["console", "--address", url.partition("://")[2], "--no-browser", *options]
        status = cli_main.run(lightpage, command)
        out, err = capsys.readouterr()
        assert status == (0 if out else EXIT_ERROR)
        return out.strip() or err

    with stage(decoder) as running:
        assert found(running.url) == f"{running.url}/"
    assert running.url.removeprefix("http://") in found(running.url)
    authority = Authority(tmp_path)
    with stage(decoder, authority.service()) as running:
        own = vars(authority.caller("watcher", ["read"]))
        assert (
            found(running.url, *(word for name in own for word in (f"--{name}", str(own[name])))) == f"{running.url}/"
        )
        assert "--certificate" in found(running.url)
        for name, path in own.items():
            monkeypatch.setenv(f"LIGHTPAGE_CLIENT_{name.upper()}", str(path))
        assert found(running.url) == f"{running.url}/"


def status_of_host(running: Stage, host: str | None, path: str = "/state.json", method: str = "GET") -> int:
    connection = http.client.HTTPConnection("127.0.0.1", running.server.port, timeout=60)
    try:
        connection.putrequest(method, path, skip_host=True)
        if host is not None:
            connection.putheader("Host", host)
        connection.endheaders()
        return connection.getresponse().status
    finally:
        connection.close()


def test_a_name_that_a_stranger_made_resolve_to_this_machine_reads_nothing(decoder: Decoder) -> None:
    with stage(decoder) as running:
        port = running.server.port
        for host in (f"127.0.0.1:{port}", f"localhost:{port}", f"[::1]:{port}", socket.gethostname(), None):
            assert status_of_host(running, host) == 200, host
        for path in ("/", "/state.json", "/metrics", "/frames/in_phase.png", "/console.js"):
            assert status_of_host(running, f"rebound.example:{port}", path) == 421
        for method in ("HEAD", "POST"):
            assert status_of_host(running, "rebound.example", "/actions", method) == 421
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
        for host in ("no-host.invalid", "a" * 64):
            with pytest.raises(OSError, match=r"\w"):
                ConsoleServer(running.console, 0, host)
