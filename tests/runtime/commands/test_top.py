"""`lightpage top`: what it says of a real service, of one that was restarted, and of one that is gone."""

import json
import math
import os
import pty
import select
import socket
import subprocess
import sys
from pathlib import Path
from threading import Thread

import pytest

from lightpage.cli import main as cli_main
from lightpage.cli.main import EXIT_ERROR, lightpage
from lightpage.runtime.commands.client.top import top
from lightpage.runtime.console.scrapes import Change, Scrape, Scrapes, scrape
from lightpage.runtime.console.server import serving
from lightpage.runtime.model.decoding.decoder import Decoder
from tests.runtime.console.stage import Stage, stage
from tests.waiting import eventually

ROOT = Path(__file__).resolve().parents[3]


def address(running: Stage) -> str:
    return running.url.removeprefix("http://").replace("localhost", "127.0.0.1")


def test_one_text_says_what_the_service_does(
    decoder: Decoder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with stage(decoder) as running:
        running.plane.metrics.call_ended("ReadPage", "OK", "", 0.5)
        before = scrape(address(running))
        running.read(10)  # two of them are lost
        asked = ["--address", address(running), "--interval", "0.1", "--once", "--json", str(tmp_path / "J")]
        assert cli_main.run(top, asked) == 0
        told = capsys.readouterr().out
        for text in ("model toy-1", "not due", "cores", "iB", "inference", "post processing", "0 of 2"):
            assert text in told, text
        assert "\x1b" not in told
        figures = json.loads((tmp_path / "J").read_text())
        assert (figures["model_version"], figures["load"]["decodes_slots"]) == ("toy-1", 2)
        assert (figures["device"]["recalibration_due"], figures["device"]["margin_bits"]) == (False, None)
        assert figures["process"]["memory_bytes"] > 1e6
        assert "inference" in {each["stage"] for each in figures["stages"]}
        change = Change(before, scrape(address(running)))
        assert change.rise("lightpage_pages_total") == 8
        assert change.rises("lightpage_pages_lost_total", "reason") == {"MISSING_FRAME": 2}
        assert 0 < change.quantile(0.5, "lightpage_decode_seconds") <= change.quantile(1.0, "lightpage_decode_seconds")
        assert change.mean("lightpage_decode_seconds") * 8 == pytest.approx(change.rise("lightpage_decode_seconds_sum"))


@pytest.mark.parametrize(
    "text", [b"up 1\n", b"<html>a page</html>\n", b"\x00\x00\x06\x04\x00\x00\x00\x00\x00\x00\x05\x00\x00\x40\x00", None]
)
def test_what_is_no_service_is_named_in_a_line(text: bytes | None, capsys: pytest.CaptureFixture[str]) -> None:
    """Other metrics, another page, what a gRPC server says, and nobody."""
    said = text or b""

    def answer(listener: socket.socket) -> None:
        connection, _ = listener.accept()
        with connection:
            connection.recv(1000)
            connection.sendall(said if said.startswith(b"\0") else b"HTTP/1.0 200 OK\r\n\r\n" + said)

    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        if text is not None:
            listener.listen()
            Thread(target=answer, args=(listener,), daemon=True).start()
        place = f"127.0.0.1:{listener.getsockname()[1]}"
        assert cli_main.run(lightpage, ["top", "--once", "--address", place]) == EXIT_ERROR
    (told,) = capsys.readouterr().err.splitlines()
    assert place in told


def test_quantiles_are_those_of_what_came_between() -> None:
    def counts(*values: float) -> dict[tuple[str, frozenset[tuple[str, str]]], float]:
        bounds = ("0.1", "1.0", "+Inf")
        return {("t_bucket", frozenset({("le", le)})): n for le, n in zip(bounds, values, strict=True)}

    change = Change(Scrape(0.0, counts(100, 100, 100)), Scrape(2.0, counts(102, 106, 108)))
    assert change.quantile(0.25, "t") == pytest.approx(0.1)
    assert change.quantile(0.5, "t") == pytest.approx(0.1 + 0.9 * 2 / 4)
    assert change.quantile(0.99, "t") == 1.0  # what lies beyond the last bound is not known
    assert math.isnan(Change(change.now, change.now).quantile(0.5, "t"))
    new = Scrape(2.0, {("lost", frozenset({("reason", "dark")})): 3.0})
    assert Change(Scrape(0.0, {}), new).rises("lost", "reason") == {"dark": 3.0}


def test_a_restart_ends_what_was_counted_before() -> None:
    def counted(at: float, calls: float, **started: float) -> Change:
        samples = {"lightpage_calls_total": calls, **started}
        scrapes.add(Scrape(at, {(name, frozenset()): value for name, value in samples.items()}))
        assert scrapes.change is not None
        return scrapes.change

    scrapes = Scrapes(window_s=10.0)
    for at in range(20):
        change = counted(float(at), 100.0 + 2 * at, process_start_time_seconds=1.0)
    assert (change.seconds, change.rate("lightpage_calls_total")) == (10.0, 2.0)
    counted(20.0, 500.0, process_start_time_seconds=2.0)
    change = counted(21.0, 503.0, process_start_time_seconds=2.0)
    assert (scrapes.restarts, change.seconds, change.rate("lightpage_calls_total")) == (1, 1.0, 3.0)
    counted(22.0, 4.0)  # of a system that tells no start
    assert scrapes.restarts == 2


def test_in_a_terminal_it_outlives_the_service_and_ends_with_q(decoder: Decoder) -> None:
    def shows(text: str) -> bool:
        seen = bytearray()

        def found() -> bool:
            if select.select([screen], [], [], 0.1)[0]:
                seen.extend(os.read(screen, 65536))
            return text.encode() in seen

        return eventually(found)

    screen, own = pty.openpty()
    with stage(decoder) as running:
        running.read(3)
        port = running.port
        code = "from lightpage.runtime.commands.client.top import top; top()"
        command = [sys.executable, "-c", code, "--address", address(running)]
        environment = {**os.environ, "TERM": "xterm", "COLUMNS": "120", "LINES": "50", "PYTHONPATH": str(ROOT)}
        process = subprocess.Popen([*command, "--interval", "0.1"], stdin=own, stdout=own, stderr=own, env=environment)
        os.close(own)
        try:
            assert shows("toy-1")
            running.close()
            assert shows("no answer")
            running.plane.metrics.in_service("toy-2")
            with serving(running.routes, port):
                assert shows("toy-2")
                os.write(screen, b"x")
                os.write(screen, b"q")
                assert shows("\x1b[?1049l")  # the screen is as it was
                assert process.wait(60) == 0
        finally:
            process.kill()
            process.wait()
            os.close(screen)
