"""Confidences among few levels, of estimates whose error rate is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from analysis.comparison.levels import level_figures
from lightpage.device.state import Device
from lightpage.page.symbols import pilot_mask, symbol_phases
from lightpage.recording.reader import Recording
from lightpage.simulator.recording_job import RecordingJob
from tests.lightpage.small import small_profile


def test_calibrated_estimates_have_the_error_rate_that_they_claim_and_bold_ones_do_not(tmp_path: Path) -> None:
    profile, rng = small_profile(), np.random.default_rng(0)
    mask, pages = pilot_mask(profile), [0, 1]
    job = RecordingJob(profile, Device(), 4, 3, truth=False, out=tmp_path / "R.h5")
    job.claim(force=False)
    job.run(len(pages))
    kappa = 3.0
    with Recording.open(tmp_path / "R.h5") as recording:
        written = [recording.symbols(page) for page in pages]
        phases = np.concatenate([symbol_phases(page, 4)[~mask] for page in written if page is not None])
        # where estimates are drawn about the true phases, a symbol is as likely to be the true one as its estimate says
        seen = phases + rng.vonmises(0, kappa, phases.shape)
        p = kappa * np.stack([np.cos(seen), np.sin(seen)]).astype(np.float32)
        calibrated, bold = (level_figures(scale * p, recording, pages, mask) for scale in (1, 3))
    wrong = np.abs(np.angle(np.exp(1j * (seen - phases)))) > np.pi / 4
    assert calibrated.symbol_error_rate == bold.symbol_error_rate == pytest.approx(wrong.mean(), abs=1e-9)
    assert 0.1 < calibrated.symbol_error_rate < 0.3
    assert calibrated.ece < 0.03 < bold.ece
    assert "not judged" not in calibrated.line("method", "size")
