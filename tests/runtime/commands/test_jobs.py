"""`lightpage recalibrate --detach` and `--send`, and `lightpage jobs`."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from lightpage.cli import main as cli_main
from lightpage.cli.main import lightpage
from runtime.client.client import LightpageClient
from runtime.decoding.decoder import Decoder
from runtime.recalibration.outcome import Refit
from runtime.rpc.server import LightpageServer
from runtime.service.dataplane import DataPlane
from runtime.service.recalibrator import Recalibrator
from runtime.service.registry import ModelRegistry
from tests.runtime import toy
from tests.runtime.slow_fit import SlowFit
from tests.waiting import eventually

Start = Callable[..., LightpageServer]


def run(*arguments: str | Path) -> int:
    return cli_main.run(lightpage, [str(argument) for argument in arguments])


@pytest.fixture
def start(decoder: Decoder) -> Iterator[Start]:
    running: list[LightpageServer] = []

    def begin(fit: Refit = toy.fit_references) -> LightpageServer:
        plane = DataPlane(ModelRegistry(decoder), toy.ToySource(toy.ToyDevice()))
        running.append(LightpageServer(plane, Recalibrator(plane, fit)).start())
        return running[-1]

    yield begin
    for server in running:
        server.stop(0.5)


def test_a_detached_job_is_named_watched_and_listed(
    start: Start, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    at = ("--target", start().target)
    assert run("jobs", *at) == 0
    assert capsys.readouterr().out == "no jobs\n"
    assert run("recalibrate", *at, "--detach", "--json", tmp_path / "j.json") == 0
    job = capsys.readouterr().out.strip()
    assert json.loads((tmp_path / "j.json").read_text()) == {"job": job}
    assert run("jobs", *at, "--watch", job) == 0
    assert "version              toy-1+r1\n" in capsys.readouterr().out
    assert run("jobs", *at) == 0
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith(f"{job}  done  ")
    assert "source" in line
    assert "toy-1+r1" in line
    assert run("jobs", *at, "--watch", "nonsense") == 2
    assert "'nonsense'" in capsys.readouterr().err


def test_a_job_can_be_cancelled(start: Start, capsys: pytest.CaptureFixture[str]) -> None:
    fit = SlowFit()
    at = ("--target", start(fit).target)
    assert run("recalibrate", *at, "--detach") == 0
    job = capsys.readouterr().out.strip()
    assert fit.entered.wait(60)
    assert run("recalibrate", *at, "--detach") == 2
    assert f"job {job}" in capsys.readouterr().err
    assert run("jobs", *at) == 0
    assert f"{job}  running" in capsys.readouterr().out
    assert run("jobs", *at, "--cancel", job) == 0
    assert f"{job}  cancelled" in capsys.readouterr().out
    assert run("jobs", *at, "--watch", job) == 2
    assert "cancelled" in capsys.readouterr().err


def test_a_recording_here_is_sent(start: Start, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    server, report = start(), tmp_path / "r.json"
    toy.write_toy_recording(tmp_path / "here.h5", toy.ToyDevice((150.0, 62.0)), 16, 5)
    sending = ("recalibrate", "--target", server.target, "--recording", tmp_path / "here.h5", "--send")
    assert run(*sending, "--pages", "3", "--json", report) == 0
    figures = json.loads(report.read_text())
    assert (figures["version"], figures["pages_used"]) == ("toy-1+r1", 3)
    assert figures["air_after"] > figures["air_before"] + 0.5
    capsys.readouterr()
    assert run(*sending, "--detach") == 0
    job = capsys.readouterr().out.strip()
    with LightpageClient(server.target) as client:
        assert client.jobs()[0].id == job
        assert {one.pages_of for one in client.jobs()} == {"frames"}


def test_a_sent_recalibration_ends_with_its_command(
    start: Start, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    server = start(SlowFit())
    toy.write_toy_recording(tmp_path / "here.h5", toy.ToyDevice(), 16, 2)
    where = ("--target", server.target, "--recording", tmp_path / "here.h5")
    assert run("recalibrate", *where, "--send", "--timeout", "1.5") == 2
    assert "deadline" in capsys.readouterr().err
    with LightpageClient(server.target) as client:
        assert eventually(lambda: {job.state for job in client.jobs()} <= {"CANCELLED"})


def test_options_that_contradict_each_other_are_named(
    toy_zip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for arguments, named in (
        (("recalibrate", "--target", "127.0.0.1:9", "--send"), "--send"),
        (("recalibrate", "--bundle", toy_zip, "--detach"), "--detach"),
        (("recalibrate", "--bundle", toy_zip, "--send"), "--send"),
        (("jobs", "--target", "127.0.0.1:9", "--watch", "a", "--cancel", "b"), "--watch"),
    ):
        assert run(*arguments) == 2
        assert named in capsys.readouterr().err
