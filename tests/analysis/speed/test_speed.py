"""Benchmarks of speed: each runs small and writes its figures."""

import json
from pathlib import Path
from typing import Any

import click
from click.testing import CliRunner

from analysis.speed import provider
from tests.runtime import toy


def figures(command: click.Command, folder: Path, *words: object) -> dict[str, Any]:
    """Run a benchmark, and return the figures that it writes."""
    asked = [*map(str, words), "--json", str(folder / "F.json")]
    CliRunner().invoke(command, asked, catch_exceptions=False, standalone_mode=False)
    found: dict[str, Any] = json.loads((folder / "F.json").read_text())
    return found


def test_a_provider_is_compared_with_the_cpu(tmp_path: Path) -> None:
    toy.write_toy_recording(tmp_path / "r.h5", toy.ToyDevice(), 256, 1)
    asked = ("--bundle", toy.write_toy_bundle(tmp_path / "toy.zip"), "--recording", tmp_path / "r.h5")
    (made,) = figures(provider.main, tmp_path, *asked, "--precision", "float32", "--seconds", 0.05)["made"]
    assert (made["precision"], made["deviation"], made["symbols_changed"]) == ("float32", 0, 0)
    assert made["air"] > 4
    assert set(made["nodes"]) == {"CPUExecutionProvider"}
