"""The real re-fit on the shipped bundle: wrong symbols and other devices are refused, and nothing is left behind."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from lightpage.calibration.calibrate import Registered
from lightpage.device.state import Device
from lightpage.errors import RecalibrationRefusedError
from lightpage.metrics.measures import measure
from lightpage.page.symbols import random_symbols
from lightpage.simulator.simulator import Simulator
from runtime.bundle.bundle import Bundle
from runtime.bundle.calibrated import calibration_of
from runtime.bundle.shipped import DEFAULT, bundle_path
from runtime.decoding.decoder import Decoder
from runtime.decoding.image_tracker import tracker_for
from runtime.decoding.page import DecodedPage
from runtime.demo.demo import drifted
from runtime.recalibration import refit as module
from runtime.recalibration.known_pages import KnownPages
from runtime.recalibration.recalibration import recalibrate
from runtime.recalibration.refit import refit

LEVELS = 16


def refused(device: Device, told: Callable[[np.ndarray], list[np.ndarray]], match: str, folder: Path) -> None:
    """Takes its seconds: two simulated pages of a bench device and the fit of one."""
    decoder = Decoder.load(bundle_path(DEFAULT))
    profile = decoder.bundle.profile
    written = random_symbols(profile, LEVELS, 4, np.random.default_rng(8))
    simulator = Simulator(profile, device, LEVELS, 8)
    pairs = tuple(simulator.page(page) for page in written[:2])
    known = KnownPages(pairs, tuple(told(written)), LEVELS, simulator.references())
    with pytest.raises(RecalibrationRefusedError, match=match):
        recalibrate(decoder, known, folder / "n.zip", "bench+r1", refit, lambda *_: None)
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize("wrong", [pytest.param((0, 1), marks=pytest.mark.long), (1,)])
def test_wrong_symbols_are_refused(wrong: tuple[int, ...], tmp_path: Path) -> None:
    def told(written: np.ndarray) -> list[np.ndarray]:
        return [written[2 + page] if page in wrong else written[page] for page in (0, 1)]

    refused(drifted(Device()), told, "right symbols" if 0 in wrong else "does not match", tmp_path)


def test_a_device_that_is_another_and_not_drifted_is_refused(tmp_path: Path) -> None:
    geometry = Device().geometry
    other = Device(geometry=geometry.model_copy(update={"pipe_angle_deg": geometry.pipe_angle_deg + 1}))
    refused(other, lambda written: [written[0], written[1]], "else calibrate anew", tmp_path)


def test_a_re_fit_starts_where_the_image_is_found(tmp_path: Path) -> None:
    """Further than the re-fit itself would look, and than a search reaches from where calibration saw the image.

    Both models are judged as the service reads, which has followed the image; no light leaves the cameras at that side.
    """
    decoder = Decoder.load(bundle_path(DEFAULT))
    profile, levels = decoder.bundle.profile, 256
    device = Device().with_settings(["drift.shift_px=0.0"])
    written = [np.asarray(page) for page in random_symbols(profile, levels, 2, np.random.default_rng(8))]
    tracker, simulator, rates = tracker_for(decoder), Simulator(profile, device, levels, 8), []
    for _ in range(2):
        rates.append(air_of(tracker.decode(simulator.page(written[0]), levels), written[0]))
        simulator.knock((-1.0, 9.0))
    known = KnownPages(tuple(map(simulator.page, written)), tuple(written), levels, simulator.references())
    outcome = recalibrate(decoder, known, tmp_path / "n.zip", "bench+r1", refit, lambda *_: None, tracker)
    assert outcome.report.image is not None
    assert (outcome.report.image.shift_x_px, outcome.report.image.shift_y_px) == pytest.approx((-2, 18), abs=0.3)
    # 98% are the aim; this is one page, and pages differ by 1%
    assert outcome.air_before > 0.97 * rates[0]
    assert outcome.air_after > 0.97 * rates[0]
    assert outcome.pages_lost_before == 0
    assert tracker.image_px == pytest.approx((-1, 9), abs=0.1)  # the service's own is left alone
    new = calibration_of(Bundle.open(outcome.path)).parameters
    old = calibration_of(decoder.bundle).parameters
    for camera in ("in_phase", "quadrature"):
        moved = [new[f"{camera}_shift_{axis}_px"] - old[f"{camera}_shift_{axis}_px"] for axis in "xy"]
        assert moved == pytest.approx((-2, 18), abs=0.1)


def air_of(page: DecodedPage, written: np.ndarray) -> float:
    return measure(page.phase, page.concentration, written, 256).air_bits_per_symbol


def test_small_losses_do_not_add_up_unseen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A re-fit that is as good as the one before is refused where the first calibration was much better than both."""

    def late(bundle: Bundle) -> object:
        return calibration_of(bundle).model_copy(update={"coherence_at_first": 1.0})

    def fitted(*_: object, start: np.ndarray, quadrature_phase: float, **__: object) -> Registered:
        return Registered(start, np.ones(len(start)), quadrature_phase, 0.0, 0.5, 1.0, 0.5)

    monkeypatch.setattr(module, "calibration_of", late)
    monkeypatch.setattr(module, "refine", fitted)
    refused(Device(), lambda written: [written[0], written[1]], "90% of the 1.000 when it was calibrated", tmp_path)
