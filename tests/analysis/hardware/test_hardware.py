"""Each benchmark of the hardware runs small; of the loop, whose measurements take hours, the sums are tested."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner

from analysis.hardware import cameras, latency, pairs, plugs, scpi
from analysis.hardware.drifting import DriftingSource, TrueTable, direction, moved
from analysis.hardware.drifts import alarms, judged
from analysis.hardware.rows import append_row, kept_rows
from analysis.hardware.week import figures_of
from analysis.hardware.week_figure import draw
from lightpage.device.state import Device
from lightpage.runtime.model.bundle.shipped import DEFAULT, bundle_path
from lightpage.runtime.model.decoding.decoder import Decoder


def measured(command: click.Command, arguments: str, folder: Path) -> Any:
    out = folder / "figures.json"
    CliRunner().invoke(command, [*arguments.split(), "--json", str(out)], standalone_mode=False, catch_exceptions=False)
    return json.loads(out.read_text())


@pytest.mark.own_network
def test_cameras(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    small = {"FULL": (128, 128), "PACKETS_BYTES": (1400,), "TOLERANCES_S": (0.02,), "FORMATS": ("Mono8", "Mono12p")}
    ticks = {"p50_ms": 1.0, "p99_ms": 1.0, "max_ms": 1.0}
    for name, value in {**small, "idle_ticks": lambda seconds: ticks}.items():
        monkeypatch.setattr(cameras, name, value)
    found = measured(cameras.main, "--changes 2 --pairs 2 --shots 2", tmp_path)
    assert (found["stale"]["changes"], found["stale"]["stale"]) == (2, 0)
    assert {name: one["other"] for name, one in found["equal"].items()} == dict.fromkeys(cameras.FORMATS, 0)
    assert [one["shots"] for one in found["speed"]] == [2]
    assert {"unpack_ms", "chain"} < set(found)


@pytest.mark.own_network
def test_pairs(tmp_path: Path) -> None:
    found = measured(pairs.main, "--shots 4 --clean-shots 0 --faults 0.6 --tolerance 0.05", tmp_path)
    faulty = found["with faults"]
    assert (faulty["wrong_pairs"], faulty["lost_unnamed"], faulty["faults"] > 0) == (0, 0, True)


@pytest.mark.own_network
def test_plugs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"AWAY_S": 0.1, "TOLERANCE_S": 0.05, "REPEATS": 20}.items():
        monkeypatch.setattr(plugs, name, value)
    found = measured(plugs.main, "--times 1", tmp_path)
    assert [found[what]["wrong_pairs"] for what in ("camera", "serial line")] == [0, 0]


# Simulates and decodes full pages of the bench device, for half a minute.
@pytest.mark.long
@pytest.mark.own_network
def test_latency(tmp_path: Path) -> None:
    found = measured(latency.main, "--pages 2", tmp_path)
    assert found["pages_lost"] + found["pages_unread"] <= 1
    assert 0 < found["without_decoding_s_p50"] < found["trigger_to_bytes_s_p50"] <= found["trigger_to_bytes_s_p99"]


def test_scpi(tmp_path: Path) -> None:
    found = measured(scpi.main, "--queries 20 --fault-rate 0.2 --unplug-every 10", tmp_path)
    assert (found["wrong_query"], found["altered"], found["unplugged"]) == (0, 0, 2)
    assert found["right"] + sum(found["lost"].values()) == found["queries"] >= 20


def test_a_row_that_was_cut_off_is_measured_again(tmp_path: Path) -> None:
    path = tmp_path / "rows.jsonl"
    assert kept_rows(path) == []
    for page in range(3):
        append_row(path, {"page": page})
    path.write_text(path.read_text() + '{"page": 3, "a')
    assert [row["page"] for row in kept_rows(path)] == [0, 1, 2]
    append_row(path, {"page": 3})
    assert [json.loads(line)["page"] for line in path.read_text().splitlines()] == [0, 1, 2, 3]


def test_the_alarm_is_held_against_the_first_page_whose_margin_is_gone() -> None:
    margins = {page: 0.12 - 0.002 * max(0, page) for page in range(-25, 70)}
    rows: list[dict[str, object]] = [
        {"page": page, "lost": "body" if left <= 0 else "", "figures": {"margin_bits": left, "unread": 0.0}}
        for page, left in margins.items()
    ]
    told = judged(1, rows)
    assert told["gone"] == 60
    assert told["alarm"] == pytest.approx(34, abs=2)
    assert told["pages_ahead"] == 60 - told["alarm"]
    assert alarms(rows[:30]) == []
    assert judged(1, rows[:30])["pages_ahead"] is None


def row(page: int, **changes: object) -> dict[str, object]:
    plain = {"page": page, "air": 6.6, "true_air": 6.6, "lost": "", "failed": False, "due": False, "during": False}
    return {**plain, "ended": [], "restarted": False, "shift_px": [0.0, 0.1], **changes}


def test_the_week_is_summed_up_and_drawn(tmp_path: Path) -> None:
    rows = [row(page) for page in range(100)]
    rows[20] = row(20, due=True)
    rows[50] = row(50, air=1.0, lost="UnconfirmedPageError", shift_px=None)
    rows[51] = row(51, air=1.0, lost="body", due=True, during=True)
    rows[52] = row(52, air=6.0, due=True, during=True, ended=["RecalibrationRefusedError"])
    rows[53] = row(53, during=True, ended=["done"])
    told = figures_of(rows, 100)
    assert told["share_of_pages_wanted"] == pytest.approx(0.97)
    assert told["pages_from_knock_to_recalibrated"] == 3
    counts = ("recalibrations", "refused_or_failed", "pages_lost", "pages_lost_but_for_the_knock", "alarms")
    assert [told[name] for name in (*counts, "false_alarms", "restarts")] == [1, 1, 2, 0, 2, 1, 0]
    draw(rows, tmp_path / "week.png", 50, 300.0)
    assert (tmp_path / "week.png").stat().st_size > 10_000


# Simulates full pages of the bench device.
@pytest.mark.long
def test_with_the_true_table_a_drifted_device_is_read_as_well_as_before() -> None:
    decoder = Decoder.load(bundle_path(DEFAULT), threads=1)
    source = DriftingSource(decoder, lambda moment: moved(Device(), moment * direction(1)), seed=1)
    true_table, found = TrueTable(decoder), list[float]()
    for moment in (0.0, 3.0):
        source.moment = moment
        found.append(true_table.air(source.truth(source.shot().page_index), source.levels))
    assert found[1] > 0.98 * found[0]
    assert source.shots == 2
