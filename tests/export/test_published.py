"""Published decoders as bundles: what the runtime says of a recording is what torch says."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from export.command import export_run
from lightpage.errors import BundleError, InvalidInputError
from lightpage.recording.reader import Recording
from runtime.commands.evaluate import evaluate
from runtime.decoding.decoder import Decoder
from runtime.recalibration.known_pages import KnownPages
from runtime.recalibration.recalibration import recalibrate
from runtime.recalibration.refit import refit
from train.commands.train import train
from train.published.trainer import published_decoder
from train.published.training import PublishedChoices
from train.runs import load_run, load_weights


@pytest.mark.parametrize(
    "localizer", [pytest.param(name, marks=pytest.mark.long) for name in ("none", "mode")] + ["ray"]
)
def test_a_published_decoder_runs_without_torch_and_says_the_same(
    localizer: str, small_device: list[str], tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    """The others differ by how they sample, and are trained here."""
    folder, out = tmp_path / "run", tmp_path / "bundle.zip"
    if localizer == "ray":
        folder = request.getfixturevalue("ray_run")
    else:
        options = [*small_device, "--localizer", localizer, "--channels", "4", "--steps", "10", "--out", str(folder)]
        CliRunner().invoke(train, options, standalone_mode=False, catch_exceptions=False)
    bundle, error = export_run(folder, out)
    assert error <= 1e-3
    run = load_run(folder)
    assert isinstance(run.hyperparameters, PublishedChoices)
    with Recording.open(small_device[3]) as recording:
        references, pair = recording.references(), recording.frames(1)
        turn = run.calibration.turn_rad
        module = published_decoder(localizer, run.hyperparameters, run.profile, references, turn)
        decoder = Decoder.load(out)
        said = decoder.infer(pair).p
        with torch.no_grad():
            frames = torch.from_numpy(np.stack([pair.in_phase, pair.quadrature])).float()[None]
            p = load_weights(folder, module)(frames, torch.zeros(1, 2))[0].numpy() * run.kappa_scale
        assert float(np.linalg.norm(said - p)) <= 1e-3 * float(np.linalg.norm(p))
        symbols = recording.symbols(0), recording.symbols(1)
        pairs = recording.frames(0), recording.frames(1)
    assert symbols[0] is not None
    assert symbols[1] is not None
    figures = tmp_path / "E.json"
    asked = ["--bundle", str(out), "--recording", small_device[3], "--json", str(figures)]
    # ten steps teach it to claim nothing
    with pytest.raises(InvalidInputError, match="1 of 8"):
        CliRunner().invoke(evaluate, asked, standalone_mode=False, catch_exceptions=False)
    assert json.loads(figures.read_text())["pages_unconfirmed"] == 1
    # its geometry is in its weights: nothing to re-trace
    pages = KnownPages(pairs, (symbols[0], symbols[1]), 256, references)
    with pytest.raises(BundleError, match="table inputs"):
        recalibrate(decoder, pages, tmp_path / "again.zip", "2", refit, lambda step, share: None)
    assert bundle.manifest.residual_limit is None
