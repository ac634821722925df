"""The demo: decoding fails by drift and comes back by what was lost, with figures that say so."""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from lightpage.demo.command import demo
from lightpage.demo.demo import run_demo
from lightpage.demo.drift import drifted
from lightpage.demo.pages import pgm
from lightpage.demo.picture import picture
from lightpage.demo.reading import summarise
from lightpage.device.state import Device
from lightpage.errors import BundleError, CalibrationError, InvalidInputError
from lightpage.page.symbols import pilot_mask, symbol_phases
from lightpage.runtime.client.answers import RemotePage, RemoteTimings
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.recalibration.refit import refit
from lightpage.runtime.recalibration.separate_process import recalibrate_apart
from tests.lightpage.command import run
from tests.runtime import toy
from tests.runtime.recalibration.toy_worker import known, quiet

ROWS = 59  # of the picture: what four pages hold
TIMINGS = RemoteTimings(0.0, 0.2, 0.1, 0.3)


def remote(errors: int = 0, kappa: float = 400.0) -> RemotePage:
    """A page whose first data symbols came out wrong by one level."""
    written = toy.symbols_of(16, 5)[0]
    mask = pilot_mask(toy.PROFILE)
    symbols = written.copy()
    where = np.argwhere(~mask)[:errors]
    symbols[tuple(where.T)] = (symbols[tuple(where.T)] + 1) % 16
    full = np.full(toy.PAGE, kappa, np.float32)
    phase = symbol_phases(symbols, 16).astype(np.float32)
    confidence = np.ones(toy.PAGE, np.float32)
    return RemotePage(symbols, confidence, full, phase, 16, 0.0, 1.0, "toy-1", TIMINGS, 0, written, mask)


def test_figures_count_data_symbols_alone() -> None:
    right, wrong = summarise("right", [remote()]), summarise("wrong", [remote(errors=10)])
    data = np.count_nonzero(~pilot_mask(toy.PROFILE))
    assert right.symbol_error_rate == 0
    assert wrong.symbol_error_rate == pytest.approx(10 / data)
    assert np.count_nonzero(np.isnan(right.air)) == toy.PAGE[0] * toy.PAGE[1] - data
    # a von Mises density of concentration 400 is a normal one of 0.05 rad, wider than a level of 256
    assert right.air_bits_per_symbol == pytest.approx(np.log2(2 * np.pi / (0.05 * np.sqrt(2 * np.pi))), abs=0.01)
    assert wrong.air_bits_per_symbol < right.air_bits_per_symbol - 1
    with pytest.raises(InvalidInputError, match="page"):  # without what was written
        summarise("x", [replace(remote(), written=None)])


def test_drift_leaves_what_cannot_drift() -> None:
    before, after = Device(), drifted(Device())
    assert after.geometry.pipe_angle_deg == pytest.approx(before.geometry.pipe_angle_deg + 0.03)
    assert after.geometry.page_shift_x_px == before.geometry.page_shift_x_px
    assert (after.sensor, after.slm, after.reference) == (before.sensor, before.slm, before.reference)


def test_a_bundle_without_code_field_or_calibration_is_no_demo(decoder: Decoder, tmp_path: Path) -> None:
    with pytest.raises(BundleError, match="code: got none"):
        run_demo(decoder.bundle.path, tmp_path, 0, calibrate=False)
    with pytest.raises(CalibrationError, match="calibration"):
        refit(decoder.bundle, known(count=1), quiet, decoder)


def test_a_picture_is_lost_by_drift_and_won_back_by_its_pages_with_the_shipped_bundle(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = picture()[:ROWS]
    shorter = {"demo.picture": lambda: small, "drift.DRIFT_STEPS": (0.15,), "pages.GROUPS": 1, "pages.PARITY_PAGES": 1}
    for name, value in shorter.items():
        monkeypatch.setattr(f"lightpage.demo.{name}", value)
    apart = partial(recalibrate_apart, worker="tests.runtime.recalibration.toy_worker:Unyielding")
    monkeypatch.setattr("lightpage.runtime.service.jobs.recalibrator.recalibrate_apart", apart)
    monkeypatch.setattr("lightpage.runtime.service.jobs.kept_pages._KEPT", 5)  # what was read before the drift is gone
    run(demo, "--no-calibrate", "--out", tmp_path)
    figures = json.loads((tmp_path / "demo.json").read_text())
    fresh, lost, again = figures["phases"]
    assert figures["pages"] == 5
    assert 2 <= figures["healing"]["pages_used"] <= 4  # one is spoilt
    assert figures["healing"]["rounds"] >= 1
    for phase in (fresh, again):
        assert (phase["pages_unread"], phase["pages_restored"], phase["pages_lost"]) == (1, 1, 0)
        assert phase["picture_exact"]
        assert phase["margin_bits_least"] > 0
    assert lost["pages_lost"] > 0
    assert not lost["picture_exact"]
    assert figures["drift"][-1]["lost"]
    assert again["air_bits_per_symbol"] >= 0.98 * fresh["air_bits_per_symbol"]
    assert again["model_version"] != fresh["model_version"] == lost["model_version"]
    assert (tmp_path / "demo.png").read_bytes().startswith(b"\x89PNG")
    read = (tmp_path / "healed.pgm").read_bytes()
    assert read == (tmp_path / "as-calibrated.pgm").read_bytes() == pgm(small)
    assert (tmp_path / "after-drift.pgm").read_bytes() != read
