"""The real re-fit on the shipped bundle: symbols that were not written are refused, and nothing is left behind."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from optics.device import Device
from optics.errors import RecalibrationRefusedError
from optics.page import random_symbols
from optics.simulator import Simulator
from runtime.decoder import Decoder
from runtime.demo import LEVELS, drifted
from runtime.recalibration import KnownPages, recalibrate
from runtime.refit import refit
from runtime.shipped import DEFAULT, bundle_path


@pytest.mark.parametrize("wrong", [(0, 1), (1,)])
def test_wrong_symbols_are_refused(wrong: tuple[int, ...], tmp_path: Path) -> None:
    """Takes its seconds: two simulated pages of the bench device and the fit of one."""
    decoder = Decoder.load(bundle_path(DEFAULT))
    profile = decoder.bundle.profile
    written = random_symbols(profile, LEVELS, 4, np.random.default_rng(8))
    simulator = Simulator(profile, drifted(Device()), LEVELS, 8)
    pairs = tuple(simulator.page(page) for page in written[:2])
    told = tuple(written[2 + page] if page in wrong else written[page] for page in (0, 1))
    known = KnownPages(pairs, told, LEVELS, simulator.references())
    with pytest.raises(RecalibrationRefusedError, match="right symbols" if 0 in wrong else "does not match"):
        recalibrate(decoder, known, tmp_path / "n.zip", "bench+r1", refit, lambda *_: None)
    assert list(tmp_path.iterdir()) == []
