"""Every benchmark can be called, and those that take hours are told how to run small."""

import importlib
import json
import os
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

import analysis
from analysis.service.other_servers.environments import NAMES, requirements
from analysis.service.other_servers.figures import Comparison, Figure
from tests.lightpage.small import small_profile

ROOT = Path(__file__).resolve().parents[2]
ELSEWHERE = ("on_ray", "on_kserve", "on_mlserver", "__main__", "triton_checks")
"""Modules that run in environments of other servers."""
SMALL: dict[str, tuple[str, ...]] = {
    "codec.safety": ("--pages", "3", "--damaged", "3"),
    "codec.speed": ("--blocks", "16", "--rounds", "1"),
    "service.changes": ("--changes", "2"),
    "attacks.identity": (),
    "service.lifecycle": ("--starts", "1", "--times", "2", "--stops", "1"),
    "attacks.memory_attacks": ("--tries", "20"),
    "attacks.outgoing": (),
    "service.overload": ("--times", "2", "--rounds", "1", "--seconds", "2", "--threads", "1"),
    "service.transport": ("--profile", "bench", "--repeats", "3"),
    "speed.footprint": ("--profile", "small.toml", "--decoder", "fast", "--pages", "2", "--threads", "1"),
    "speed.speed": ("--profile", "small.toml", "--decoder", "coherent", "--repeats", "1", "--threads", "1"),
    "speed.scaling": ("--profile", "small.toml", "--factor", "1", "--factor", "2", "--repeats", "1"),
    "scaling.second_run": ("--pages", "40", "--repeats", "1", "--out", "out"),
}


def test_every_benchmark_says_how_it_is_called() -> None:
    called = 0
    for module in pkgutil.walk_packages(analysis.__path__, "analysis."):
        if module.name.rpartition(".")[2] in ELSEWHERE:
            continue
        command = getattr(importlib.import_module(module.name), "main", None)
        if isinstance(command, click.Command):
            called += 1
            assert CliRunner().invoke(command, ["--help"]).exit_code == 0, module.name
    assert called > 35


@pytest.mark.long  # the service, shipped bundles and bulk runs in processes of their own, half a minute each
@pytest.mark.parametrize("name", SMALL)
def test_it_runs_small_and_writes_its_figures(name: str, tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(small_profile().to_toml())
    command = [sys.executable, "-m", f"analysis.{name}", *SMALL[name], "--json", "F.json"]
    there = {**os.environ, "PYTHONPATH": str(ROOT)}  # benchmarks are not installed
    done = subprocess.run(command, cwd=tmp_path, env=there, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stdout + done.stderr
    assert json.loads((tmp_path / "F.json").read_text())


def test_a_server_is_better_only_by_more_than_the_larger_spread() -> None:
    figure = Figure.of([float(value) for value in range(101)])
    assert (figure.p10, figure.p50, figure.p90) == pytest.approx((10, 50, 90))
    own = Figure(9, 10, 11)
    assert Comparison.of(own, Figure(14, 15, 16)) == Comparison(difference=5, spread=2)
    assert Comparison.of(own, Figure(10, 15, 20)).missed_by == 5
    assert Comparison.of(own, Figure(4, 5, 6), more_is_better=True).missed_by == -3


def test_all_environments_are_pinned_and_have_the_onnx_runtime_of_the_service() -> None:
    own = dict(re.findall(r"^([\w.-]+)==(\S+)$", (ROOT / "constraints.txt").read_text("utf-8"), re.M))
    for name in NAMES:
        pinned = dict(line.split("==") for line in requirements(name).split())
        assert name in pinned
        assert all(pinned[key] == own[key] for key in ("onnxruntime", "grpcio", "numpy"))
