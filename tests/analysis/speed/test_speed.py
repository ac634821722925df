"""Benchmarks of speed: each runs small and writes its figures."""

import json
from pathlib import Path

from click.testing import CliRunner

from analysis.speed import provider
from tests.runtime import toy


def test_a_provider_is_compared_with_the_cpu(tmp_path: Path) -> None:
    toy.write_toy_recording(tmp_path / "r.h5", toy.ToyDevice(), 256, 1)
    asked = ("--bundle", toy.write_toy_bundle(tmp_path / "toy.zip"), "--recording", tmp_path / "r.h5")
    asked += "--precision", "float32", "--seconds", 0.05, "--json", tmp_path / "F.json"
    CliRunner().invoke(provider.main, [*map(str, asked)], catch_exceptions=False, standalone_mode=False)
    (made,) = json.loads((tmp_path / "F.json").read_text())["made"]
    assert (made["precision"], made["deviation"], made["symbols_changed"]) == ("float32", 0, 0)
    assert made["air"] > 4
    assert set(made["nodes"]) == {"CPUExecutionProvider"}
