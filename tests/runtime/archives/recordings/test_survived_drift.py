"""How much drift a code survives, by pages that were recorded before it."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from lightpage.cli.simulate import simulate
from lightpage.codec.choose import Draw
from lightpage.metrics.information import achievable_rate
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings import survived_drift
from lightpage.runtime.archives.recordings.coded_pages import SeenPages
from lightpage.runtime.archives.recordings.evaluation import unseen_pages
from lightpage.runtime.archives.recordings.survived_drift import KINDS, DriftedReading
from lightpage.runtime.commands.archives.code import code
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from tests.lightpage.command import run


def recorded(small_device: list[str], out: Path, *settings: str) -> Path:
    """Some pages of the small device that no bundle has seen, changed by settings."""
    more = [word for setting in settings for word in ("--set", setting)]
    run(simulate, *small_device[:2], "--pages", 4, "--seed", 9, "--out", out, *more)
    return out


@pytest.fixture(scope="module")
def reading(
    small_bundle: Path, small_device: list[str], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[DriftedReading]:
    out = recorded(small_device, tmp_path_factory.mktemp("recorded") / "R.h5")
    with Recording.open(out) as recording:
        yield DriftedReading(Decoder.load(small_bundle, threads=1), recording)


def air(draw: Draw) -> float:
    """Of pages of 256 levels that are drawn, bits a symbol."""
    rates = [
        achievable_rate(one.phase - one.levels.phases[one.symbols], one.concentration, 0 * one.symbols, 256)
        for one in draw(256, np.random.default_rng(0))
    ]
    return float(np.mean(rates))


@pytest.mark.parametrize(
    ("kind", "amount", "setting"),
    [
        ("angle", 0.15, "geometry.pipe_angle_deg=-0.75"),
        ("camera", 0.75, "quadrature_camera.shift_x_px=-4.75"),
        ("stroke", 6.0, "slm.stroke_relative_error=-0.06"),
    ],
)
def test_a_table_that_is_off_reads_pages_as_those_of_a_device_that_has_drifted(
    kind: str,
    amount: float,
    setting: str,
    reading: DriftedReading,
    small_bundle: Path,
    small_device: list[str],
    tmp_path: Path,
) -> None:
    drift, decoder = reading.drifted({kind: amount}), Decoder.load(small_bundle, threads=1)
    assert drift is not None
    with Recording.open(recorded(small_device, tmp_path / "D.h5", setting)) as recording:
        pages = list(unseen_pages(decoder, recording, tracker_for(decoder), "read", []))[:3]  # as many
        drifted = air(SeenPages.of(decoder, recording, pages).draw)
    cost = air(drift.before) - drifted
    assert cost > 0.03
    assert air(drift.before) - air(drift.after) == pytest.approx(cost, rel=0.25)


def test_no_page_is_read_after_too_much_drift(reading: DriftedReading) -> None:
    assert reading.drifted({"camera": 40.0}) is None


def test_the_command_keeps_what_a_drift_costs(
    reading: DriftedReading, small_bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(survived_drift, "KINDS", {"angle": KINDS["angle"]})
    asked = ["--bundle", small_bundle, "--recording", reading.recording.path, "--out", tmp_path / "C.toml"]
    figures = []
    for more in ([], ["--survive", "angle", "0.1"]):
        told = run(code, *asked, "--json", tmp_path / "J.json", *more)
        assert "survives: the pipe's angle off by " in told
        figures.append(json.loads((tmp_path / "J.json").read_text()))
    plain, sure = figures
    assert sure["headroom_bits_per_symbol"] > plain["headroom_bits_per_symbol"] > 0
    assert sure["user_bytes_per_page"] < plain["user_bytes_per_page"]
    assert sure["drift_survived"]["angle"] >= 0.1
    assert sure["drift_survived"]["angle"] > plain["drift_survived"]["angle"] > 0
    assert sure["user_bytes_per_page_without_headroom"] > sure["user_bytes_per_page"]
    assert sure["survive"] == {"angle": 0.1}
