"""Several processes train as one does with all of their pages, and what cannot be is told before anything is begun."""

import os
import socket
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import lightning as L
import pytest
import torch

from lightpage.errors import InvalidInputError, LightpageError
from lightpage.train.fitting.curves import curves_of
from lightpage.train.processes import Processes, is_first_process, process_number, wait_for_first
from tests.clock import HandClock
from tests.train.node import STEPS, train

SECONDS = 240
ROUNDING = 1e-5
"""Rounding of float32: sums of four pages and of twice two differ in order. Weights were found to differ by 2e-7."""


def on_two_nodes(out: Path) -> list[str]:
    """Train on two nodes that meet on this machine, and return what either prints."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        meeting = {**os.environ, "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(found.getsockname()[1])}
    command = [sys.executable, "-m", "tests.train.node", str(out), "2"]
    nodes = [
        subprocess.Popen(command, env=meeting | {"NODE_RANK": node}, text=True, stdout=subprocess.PIPE) for node in "01"
    ]
    try:
        told = [node.communicate(timeout=SECONDS)[0] for node in nodes]
    finally:
        for node in nodes:
            node.kill()
    assert [node.returncode for node in nodes] == [0, 0]
    return told


def test_two_nodes_train_as_one_process_does_with_the_pages_of_both(tmp_path: Path) -> None:
    one = train(tmp_path / "one", 1)
    two = on_two_nodes(tmp_path / "two")
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


def test_the_end_of_another_process_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken = Mock(side_effect=RuntimeError("[/gloo/transport/tcp/pair.cc] Read error: Connection reset by peer"))
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
        (Processes(1, 2), MEETING, "got no NODE_RANK"),
        (Processes(1, 2), {**MEETING, "NODE_RANK": "2"}, "NODE_RANK: got 2"),
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
