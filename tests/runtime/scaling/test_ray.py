"""Ray: the same results, and a node that dies costs what was being read on it. Starting a cluster takes ten seconds."""

from __future__ import annotations

import os
import signal
import sys
import uuid
from pathlib import Path

import pytest

from lightpage.cli.main import run as run_command
from runtime.commands import bulk as command
from runtime.scaling.driver import run
from runtime.scaling.inline import InlineEngine
from runtime.scaling.job import Choices, of_recordings
from runtime.scaling.ledger import Ledger
from runtime.scaling.ray_engine import RayEngine
from runtime.scaling.task import Done, Operation
from runtime.scaling.work import Worker
from tests.runtime import toy
from tests.runtime.scaling.test_local import pages

PAGES, RANGE = 60, 5


def test_without_ray_the_extra_is_named(
    toy_zip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    toy.write_toy_recording(tmp_path / "a.h5", toy.ToyDevice(), 16, 2)
    monkeypatch.setitem(sys.modules, "ray", None)  # as if it were not there
    words = ["decode", str(tmp_path / "out"), "--recordings", str(tmp_path / "a.h5"), "--bundle", str(toy_zip)]
    assert run_command(command.bulk, [*words, "--engine", "ray"]) == 2
    assert "pip install 'lightpage[cluster]'" in capsys.readouterr().err


@pytest.mark.long
def test_a_worker_and_a_node_die_and_nothing_is_missing_twice_or_different(
    toy_zip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from ray.cluster_utils import Cluster

    mark = uuid.uuid4().hex
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    monkeypatch.setenv("LIGHTPAGE_MARK", mark)
    toy.write_toy_recording(tmp_path / "a.h5", toy.ToyDevice(seed=1), 16, PAGES)
    choices = Choices(operation=Operation.EVALUATE, range_pages=RANGE)
    job = of_recordings(choices, [str(tmp_path / "a.h5")], str(toy_zip), None)
    with Ledger(tmp_path / "single") as ledger:
        run(ledger, job, lambda: InlineEngine(Worker(1)))
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    try:
        node = cluster.add_node(num_cpus=1)
        engine = RayEngine(cluster.address, threads=1)
        with Ledger(tmp_path / "killed") as ledger:
            done = []
            for outcome in engine.run(ledger.missing(job)):
                assert isinstance(outcome, Done)
                done.append(outcome.task.pages)
                if len(done) == 2:
                    cluster.remove_node(node, allow_graceful=False)
                    cluster.add_node(num_cpus=1)
                if len(done) == 4:
                    worker = working(mark)[0]
                    # what it was started with: the C library looks at no later word
                    assert b"MALLOC_ARENA_MAX=2" in Path(f"/proc/{worker}/environ").read_bytes().split(b"\0")
                    os.kill(worker, signal.SIGKILL)
        assert sorted(done) == [tuple(range(first, first + RANGE)) for first in range(0, PAGES, RANGE)]
        assert pages(tmp_path / "killed") == pages(tmp_path / "single")
        assert engine.restarts >= 1
    finally:
        cluster.shutdown()


def working(mark: str) -> list[int]:
    """Processes that Ray works with, of the cluster with this mark in its environment."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            name, environment = ((folder / part).read_bytes() for part in ("cmdline", "environ"))
        except OSError:
            continue
        if b"ray::_work" in name and mark.encode() in environment:
            found.append(int(folder.name))
    return found
