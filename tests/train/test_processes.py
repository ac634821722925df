"""Several processes train as one does with all of their pages, and what cannot be is told before anything is begun."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import lightning as L
import pytest
import torch

from lightpage.errors import InvalidInputError, LightpageError
from tests.clock import HandClock
from tests.train.node import STEPS, train
from train.fitting.curves import curves_of
from train.processes import Processes, is_first_process, process_number, wait_for_first

SECONDS = 240
ROUNDING = 1e-5
"""Of float32: sums of four pages and of twice two come in another order. Weights were found to differ by 2e-7."""


def meeting(node: int, port: int) -> dict[str, str]:
    return {**os.environ, "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "NODE_RANK": str(node)}


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


def on_two_nodes(command: list[str]) -> list[str]:
    """What the same command prints on either of two nodes that meet on this machine."""
    port = free_port()
    nodes = [
        subprocess.Popen(command, env=meeting(node, port), text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        for node in (0, 1)
    ]
    try:
        told = [node.communicate(timeout=SECONDS) for node in nodes]
    finally:
        for node in nodes:
            node.kill()
    for node, (_, errors) in zip(nodes, told, strict=True):
        assert node.returncode == 0, errors
    return [output for output, _ in told]


def test_two_nodes_train_as_one_process_does_with_the_pages_of_both(tmp_path: Path) -> None:
    one = train(tmp_path / "one", 1)
    two = on_two_nodes([sys.executable, "-m", "tests.train.node", str(tmp_path / "two"), "2"])
    single, double = (
        torch.load(tmp_path / name / "checkpoints/last.ckpt", map_location="cpu", weights_only=False)["state_dict"]
        for name in ("one", "two")
    )
    for name, weights in single.items():
        torch.testing.assert_close(double[name], weights, rtol=ROUNDING, atol=ROUNDING, msg=name)
    assert two[0] == two[1]
    assert float(two[0]) == pytest.approx(one, abs=ROUNDING)
    curves = [dict(curves_of(tmp_path / name)["val_air"]) for name in ("one", "two")]
    assert len(curves[0]) == STEPS
    assert curves[1] == pytest.approx(curves[0], abs=ROUNDING)  # by step, the mean over the processes


@pytest.mark.long  # two processes that each load torch, and a third
def test_the_command_trains_on_two_nodes_and_goes_on_with_one(small_device: list[str], tmp_path: Path) -> None:
    out = tmp_path / "run"
    small = [*small_device, "--channels", "8", "--blocks", "1", "--synthetic-pages", "0", "--steps", "60"]
    words = [*small, "--devices", "1", "--out", str(out)]
    command = [sys.executable, "-m", "lightpage.cli.main", "train", *words]
    told = on_two_nodes([*command, "--nodes", "2"])
    assert [bool(output) for output in told] == [True, False]
    assert json.loads((out / "run.json").read_text())["validation_air"] > 0.5
    (out / "run.json").unlink()
    again = subprocess.run(command, capture_output=True, text=True, timeout=SECONDS)
    assert again.returncode == 0, again.stderr
    assert again.stdout == told[0]


def test_the_end_of_another_process_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object, **__: object) -> None:
        raise RuntimeError("[/gloo/transport/tcp/pair.cc] Read error: Connection reset by peer")

    monkeypatch.setattr(L.Trainer, "fit", broken)
    with pytest.raises(RuntimeError, match="Read error"):
        train(tmp_path / "alone", 1)
    monkeypatch.setattr(L.Trainer, "world_size", 2)
    with pytest.raises(LightpageError, match="another process"):
        train(tmp_path / "two", 1)


MEETING = {"MASTER_ADDR": "h", "MASTER_PORT": "1"}
TORCHRUN = {"TORCHELASTIC_RUN_ID": "r", "RANK": "0", "WORLD_SIZE": "1", "LOCAL_WORLD_SIZE": "1"}


@pytest.mark.parametrize(
    ("asked", "environment", "named"),
    [
        (Processes(10_000), {}, "--devices: got 10000"),
        (Processes(1, 2), {}, "MASTER_ADDR, MASTER_PORT, NODE_RANK"),
        (Processes(1, 2), MEETING, "got no NODE_RANK"),
        (Processes(1, 2), {**MEETING, "NODE_RANK": "2"}, "NODE_RANK: got 2"),
        (Processes(1, 2), {**MEETING, "MASTER_PORT": "x", "NODE_RANK": "1"}, "MASTER_PORT: got x"),
        (Processes(1), {"NODE_RANK": "1"}, "NODE_RANK: got 1"),
        (Processes(2), TORCHRUN, "--devices: got 2"),
    ],
)
def test_processes_that_cannot_be_are_told(
    asked: Processes, environment: dict[str, str], named: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(InvalidInputError, match=named):
        asked.checked()


def test_torchrun_says_how_many_there_are_and_which_one_this_is(monkeypatch: pytest.MonkeyPatch) -> None:
    started = {"RANK": "5", "LOCAL_RANK": "0", "WORLD_SIZE": "8", "LOCAL_WORLD_SIZE": "1"}
    for name, value in {"TORCHELASTIC_RUN_ID": "r", **started}.items():
        monkeypatch.setenv(name, value)
    assert Processes().checked() == Processes(1, 8)
    assert (process_number(), is_first_process()) == (5, False)


def test_every_process_of_every_node_has_a_number_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    numbers = []
    for node in range(3):
        for local in range(8):
            monkeypatch.setenv("NODE_RANK", str(node))
            monkeypatch.setenv("LOCAL_RANK", str(local))
            numbers.append(process_number())
    assert len(set(numbers)) == len(numbers)
    assert numbers[0] == 0


def test_a_process_waits_as_long_as_the_first_one_makes_progress() -> None:
    clock, parts = HandClock(), iter([0, 1, 1, 2, 3])
    wait_for_first(lambda: next(parts), 3, "parts", clock)
    start = clock.now()
    with pytest.raises(LightpageError, match=r"^parts: got 2"):
        wait_for_first(lambda: min(2, int((clock.now() - start) / 1000)), 3, "parts", clock)
    assert clock.now() - start == pytest.approx(2000 + 1800, abs=1)
