"""Claims about registration on pages smaller than the shipped devices': how far it gets, and what it says then."""

from __future__ import annotations

import numpy as np
import pytest

from optics.device import Device
from optics.errors import CalibrationError
from optics.page import symbol_phases
from optics.profile import PageLayout, load_profile
from optics.registration.calibrate import KnownPage, calibrate
from optics.simulator import Simulator
from train.field import FieldRecovery, TorchFieldSolver
from train.twin import RayTwin, TorchTwin


def test_a_page_that_hardly_meets_the_walls_is_found_directly_and_then_named_as_too_narrow() -> None:
    bench = load_profile("bench")
    profile = bench.model_copy(
        update={
            "page": PageLayout(columns=30, rows=20, symbol_size_px=4),
            "camera": bench.camera.model_copy(update={"columns_px": 560, "rows_px": 400}),
        }
    )
    simulator = Simulator(profile, Device(), levels=16, seed=3)
    symbols = np.random.default_rng(0).integers(16, size=profile.page_shape).astype(np.uint8)
    page = KnownPage(simulator.page(symbols), np.exp(1j * symbol_phases(symbols, 16)))
    with pytest.raises(CalibrationError, match=r"'find the reflections'.*wide enough for its light to meet the pipe's"):
        calibrate(
            TorchTwin(RayTwin(profile)),
            TorchFieldSolver(FieldRecovery(profile)),
            profile,
            simulator.references(),
            [page],
        )
