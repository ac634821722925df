"""Published decoders as bundles: what the runtime says of a recording is what torch says."""

from pathlib import Path

import numpy as np
import pytest
import torch

from lightpage.errors import BundleError
from lightpage.export.from_run import export_run
from lightpage.recording.reader import Recording
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.recalibration.known_pages import KnownPages
from lightpage.runtime.recalibration.recalibration import recalibrate
from lightpage.runtime.recalibration.refit import refit
from lightpage.train.published.trainer import published_decoder
from lightpage.train.published.training import PublishedChoices
from lightpage.train.runs import load_run, load_weights


@pytest.mark.usefixtures("ready_twin")
def test_a_published_decoder_runs_without_torch_and_says_the_same(
    ray_run: Path, small_device: list[str], tmp_path: Path
) -> None:
    out = tmp_path / "bundle.zip"
    bundle, error = export_run(ray_run, out)
    assert error <= 1e-3
    run = load_run(ray_run)
    assert isinstance(run.hyperparameters, PublishedChoices)
    with Recording.open(small_device[3]) as recording:
        references, pair = recording.references(), recording.frames(1)
        turn = run.calibration.turn_rad
        module = published_decoder("ray", run.hyperparameters, run.profile, references, turn)
        decoder = Decoder.load(out)
        said = decoder.infer(pair).p
        with torch.no_grad():
            frames = torch.from_numpy(np.stack([pair.in_phase, pair.quadrature])).float()[None]
            p = load_weights(ray_run, module)(frames, torch.zeros(1, 2))[0].numpy() * run.kappa_scale
        assert float(np.linalg.norm(said - p)) <= 1e-3 * float(np.linalg.norm(p))
        symbols = np.stack([recording.symbols(page) for page in (0, 1)])
        pairs = recording.frames(0), recording.frames(1)
    # its geometry is in its weights: nothing to re-trace
    pages = KnownPages(pairs, tuple(symbols), 256, references)
    with pytest.raises(BundleError, match="table inputs"):
        recalibrate(decoder, pages, tmp_path / "again.zip", "2", refit, lambda step, share: None)
    assert bundle.manifest.residual_limit is None
