"""Every benchmark can be called, and those that take hours are told how to run small."""

from __future__ import annotations

import importlib
import json
import pkgutil
import subprocess
import sys
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

import analysis

ELSEWHERE = ("on_ray", "on_kserve", "on_mlserver", "__main__", "triton_checks")
"""What runs in environments of other servers."""
SMALL: dict[str, tuple[str, ...]] = {
    "codec.safety": ("--pages", "3", "--damaged", "3"),
    "codec.speed": ("--blocks", "16", "--rounds", "1"),
    "service.changes": ("--changes", "2"),
    "service.identity": (),
    "service.lifecycle": ("--starts", "1", "--times", "2", "--stops", "1"),
    "service.memory_attacks": ("--tries", "20"),
    "service.outgoing": (),
    "service.overload": ("--times", "2", "--rounds", "1", "--seconds", "2", "--threads", "1"),
    "service.transport": ("--profile", "bench", "--repeats", "3"),
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
    command = [sys.executable, "-m", f"analysis.{name}", *SMALL[name], "--json", "F.json"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stdout + done.stderr
    assert json.loads((tmp_path / "F.json").read_text())
