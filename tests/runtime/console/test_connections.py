"""Connections to the console: one that says nothing or breaks holds up nobody, and their number is bounded."""

from __future__ import annotations

import errno
import socket
import ssl
import urllib.request
from pathlib import Path

import pytest

from runtime.decoding.decoder import Decoder
from tests.runtime.console.stage import Stage, stage
from tests.runtime.identity.authority import Authority
from tests.waiting import eventually


def is_answered(running: Stage, context: ssl.SSLContext | None = None) -> bool:
    try:
        with urllib.request.urlopen(f"{running.url}/metrics", timeout=60, context=context) as reply:
            return bool(reply.status == 200)
    except OSError:
        return False


def connected(running: Stage) -> socket.socket:
    return socket.create_connection(("localhost", running.server.port), timeout=60)


def test_callers_that_say_nothing_or_hang_up_hold_up_nobody(
    decoder: Decoder, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    authority = Authority(tmp_path)
    own = authority.caller("watcher", ["read"])
    context = ssl.create_default_context(cafile=str(own.ca))
    context.load_cert_chain(own.certificate, own.key)
    with stage(decoder, authority.service()) as running, connected(running):
        assert is_answered(running, context)
        with context.wrap_socket(connected(running), server_hostname="localhost") as hung_up:
            hung_up.sendall(b"GET /metrics HTTP/1.1\r\n\r\n")
        assert is_answered(running, context)
    assert capfd.readouterr().err == ""


def test_a_body_that_does_not_come_is_refused_and_nothing_else_is_said(
    decoder: Decoder, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("runtime.console.server.SILENCE_S", 0.1)
    with stage(decoder) as running, connected(running) as connection:
        connection.sendall(b"POST /actions HTTP/1.1\r\nContent-Length: 100\r\n\r\nx")
        assert b" 408 " in connection.recv(1000)
    assert capfd.readouterr().err == ""


def test_connections_are_bounded_in_number_and_in_time(decoder: Decoder, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("runtime.console.server.MOST_CONNECTIONS", 3)
    monkeypatch.setattr("runtime.console.server.LONGEST_S", 0.5)
    with stage(decoder) as running:
        silent = [connected(running) for _ in range(3)]
        with connected(running) as late:
            assert late.recv(1) == b"", "there is no room for a fourth one"
        for connection in silent:
            assert connection.recv(1) == b"", "it was held for long enough"
            connection.close()
        assert eventually(lambda: is_answered(running))


@pytest.mark.parametrize(
    ("lacking", "error"),
    [
        ("threading.Timer.start", RuntimeError("can't start new thread")),
        ("socket.socket.dup", OSError(errno.EMFILE, "Too many open files")),
    ],
)
def test_a_connection_that_cannot_be_answered_gives_its_room_back(
    decoder: Decoder, monkeypatch: pytest.MonkeyPatch, lacking: str, error: Exception
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr("runtime.console.server.MOST_CONNECTIONS", 1)
    with stage(decoder) as running:
        with monkeypatch.context() as patch:
            patch.setattr(lacking, fail)
            with connected(running) as connection:
                assert connection.recv(1) == b""
        assert eventually(lambda: is_answered(running))
