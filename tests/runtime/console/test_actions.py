"""The console's actions: for administrators alone, and never in their name by a page of somebody else's."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from pathlib import Path
from wsgiref.util import setup_testing_defaults

import pytest

from runtime.acquisition.source import Shot
from runtime.console.actions import Actions
from runtime.console.history import History
from runtime.console.server import IDENTITY, Console
from runtime.decoding.decoder import Decoder
from runtime.identity.roles import NOBODY, Identity, Role
from runtime.service.caller import Actor, Caller
from runtime.service.dataplane import DataPlane
from runtime.service.monitor import Monitor
from runtime.service.recalibrator import Recalibrator
from runtime.service.registry import ModelRegistry
from tests.clock import HandClock
from tests.runtime import toy

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
        self.plane = DataPlane(ModelRegistry(decoder), self.source)
        self.plane.adopt(Decoder.load(toy.write_toy_bundle(folder / "c.zip", version="toy-2"), 1))
        self.recalibrator = Recalibrator(self.plane, toy.fit_references)
        actions = Actions(self.plane, self.recalibrator)
        registry, metrics = self.plane.registry, self.plane.metrics
        self.console = Console(metrics, History(), registry, Monitor(), "toy", actions, self.clock.now)

    @property
    def version(self) -> str:
        return self.plane.registry.current.version

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
    assert asked.plane.read_page(None, None, Caller()).shot.page_index == 0


@pytest.mark.parametrize("roles", [[Role.READ], [Role.DECODE, Role.RECALIBRATE], []])
def test_nobody_else_does(roles: list[Role], asked: Asked) -> None:
    caller = Identity("other", frozenset(roles))
    assert asked.act(caller)[0] == 403
    assert asked.version == "toy-2"
    assert asked.ask("/state.json", caller)[0] == (200 if roles else 403)
    assert asked.console.state(caller)["actions"] == []


def test_who_proves_nothing_does_nothing(asked: Asked) -> None:
    assert asked.act(NOBODY)[0] == asked.act(None)[0] == 403
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
