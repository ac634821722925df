"""Each benchmark of the hardware runs small; of the loop, whose measurements take hours, the sums are tested."""

import json
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner

from analysis.hardware import cameras, latency, pairs, plugs, scpi
from analysis.hardware.week import figures_of, table_of
from analysis.hardware.week_figure import draw


def measured(command: click.Command, arguments: str, folder: Path) -> Any:
    out = folder / "figures.json"
    CliRunner().invoke(command, [*arguments.split(), "--json", str(out)], standalone_mode=False, catch_exceptions=False)
    return json.loads(out.read_text())


# Full frames of two formats over loopback; what the driver does with them is tested by itself.
@pytest.mark.long
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


def row(page: int, **changes: object) -> dict[str, object]:
    plain = {"page": page, "air": 6.6, "true_air": 6.6, "lost": "", "failed": False, "due": False, "during": False}
    light = {"true": {"stroke": -1e-4 * page}, "fitted": {"stroke": 0.0}}
    return {**plain, **light, "ended": [], "restarted": False, "shift_px": [0.0, 0.1], **changes}


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
    assert table_of(rows, 100)[7] == "| 50-59 | 5.420 | 0.821 | 1 | 2 | -0.0059, 0.0000 |"
    draw(rows, tmp_path / "week.png", 50, 300.0)
    assert (tmp_path / "week.png").stat().st_size > 10_000
