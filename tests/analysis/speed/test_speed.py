"""Benchmarks of speed: each runs small and writes its figures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner

from analysis.speed import provider
from analysis.speed.fidelity import FORMS, HALF, measured, name_of
from lightpage.recording.reader import Recording
from lightpage.runtime.model.decoding.decoder import Decoder
from tests.runtime import toy


def figures(command: click.Command, folder: Path, *words: object) -> dict[str, Any]:
    """What a benchmark writes."""
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


def test_forms_of_a_decoder_are_compared_with_the_usual_one(tmp_path: Path) -> None:
    toy.write_toy_recording(tmp_path / "r.h5", toy.ToyDevice(), 256, 3)
    usual, doubtful = toy.decoder_onnx(), toy.decoder_onnx(kappa=100.0)
    decoder = Decoder.load(toy.write_toy_bundle(tmp_path / "toy.zip"))
    with Recording.open(tmp_path / "r.h5") as recording:
        models = {"usual": usual, "doubtful": doubtful}
        forms = {form.name: form for form in measured(decoder, models, doubtful, recording, 2, "usual")}
    assert forms["usual"].air > forms["doubtful"].air == forms[HALF].air > 4
    assert (forms["usual"].deviation, forms["doubtful"].deviation) == (0, pytest.approx(0.75, abs=1e-3))
    assert len({name_of(form) for form in FORMS}) == len(FORMS)
