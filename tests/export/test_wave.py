"""A decoder by waves as a bundle: parity with torch, decoding without it, and what it cannot do."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from export.cli_export import export_run
from optics.errors import BundleError
from optics.recording import Recording
from runtime.cli_evaluate import evaluate
from runtime.decoder import Decoder
from runtime.recalibration import KnownPages, recalibrate
from runtime.refit import refit
from train.cli_train import train
from train.run import load_run


def test_a_decoder_by_waves_is_exported_and_decodes_without_torch(small_device: list[str], tmp_path: Path) -> None:
    folder, out, figures = tmp_path / "run", tmp_path / "bundle.zip", tmp_path / "E.json"
    size = ["--channels", "8", "--blocks", "1", "--steps", "60", "--synthetic-pages", "0"]
    options = [*small_device, "--localizer", "wave", *size, "--out", str(folder)]
    CliRunner().invoke(train, options, standalone_mode=False, catch_exceptions=False)
    _, error = export_run(folder, out)
    assert error <= 1e-3
    asked = ["--bundle", str(out), "--recording", small_device[3], "--json", str(figures)]
    CliRunner().invoke(evaluate, asked, standalone_mode=False, catch_exceptions=False)
    # of the same light as the validation page, with honest concentrations on top
    assert json.loads(figures.read_text())["air_bits_per_symbol"] > load_run(folder).validation_air > 1
    with Recording.open(small_device[3]) as recording:
        pairs = recording.frames(0), recording.frames(1)
        first, second, references = recording.symbols(0), recording.symbols(1), recording.references()
    assert first is not None
    assert second is not None
    pages = KnownPages(pairs, (first, second), 256, references)
    with pytest.raises(BundleError, match=r"table inputs.*calibrate, train and export anew"):
        recalibrate(Decoder.load(out), pages, tmp_path / "again.zip", "2", refit, lambda step, share: None)
