"""Each benchmark of the hardware runs small and writes its figures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner

from analysis.hardware import cameras, latency, pairs, plugs, scpi


def measured(command: click.Command, arguments: str, folder: Path) -> Any:
    out = folder / "figures.json"
    CliRunner().invoke(command, [*arguments.split(), "--json", str(out)], standalone_mode=False, catch_exceptions=False)
    return json.loads(out.read_text())


@pytest.mark.own_network
def test_cameras(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cameras, "FULL", (128, 128))
    monkeypatch.setattr(cameras, "PACKETS_BYTES", (1400,))
    monkeypatch.setattr(cameras, "TOLERANCES_S", (0.02,))
    monkeypatch.setattr(cameras, "idle_ticks", lambda seconds: {"p50_ms": 1.0, "p99_ms": 1.0, "max_ms": 1.0})
    found = measured(cameras.main, "--changes 2 --pairs 2 --shots 2", tmp_path)
    assert (found["stale"]["changes"], found["stale"]["stale"]) == (2, 0)
    assert {name: one["other"] for name, one in found["equal"].items()} == dict.fromkeys(cameras.FORMATS, 0)
    assert [one["shots"] for one in found["speed"]] == [2]
    assert set(found["unpack_ms"]) == {*cameras.FORMATS, "Mono12p, plain"}
    for one in found["chain"]:
        slower = min(one["cameras_alone_per_s"], one["pairing_alone_per_s"])
        assert one["ratio"] == pytest.approx(one["pairs_per_s"] / slower)


@pytest.mark.own_network
def test_pairs(tmp_path: Path) -> None:
    found = measured(pairs.main, "--shots 4 --clean-shots 0 --faults 0.6 --tolerance 0.05", tmp_path)
    faulty = found["with faults"]
    assert faulty["wrong_pairs"] == faulty["lost_unnamed"] == 0
    assert faulty["faults"] > 0
    assert faulty["taken"] + sum(sum(reasons.values()) for reasons in faulty["lost"].values()) == 4


@pytest.mark.own_network
def test_plugs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plugs, "AWAY_S", 0.1)
    monkeypatch.setattr(plugs, "TOLERANCE_S", 0.05)
    monkeypatch.setattr(plugs, "REPEATS", 20)
    found = measured(plugs.main, "--times 1", tmp_path)
    for what in ("camera", "serial line"):
        assert (found[what]["times"], found[what]["wrong_pairs"]) == (1, 0)


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
