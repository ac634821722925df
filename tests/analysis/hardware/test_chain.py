"""The measurements over the whole chain count what they say: few shots of each, in a private network."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner

from analysis.hardware import latency, pairs, plugs

pytestmark = pytest.mark.own_network


def measured(command: click.Command, arguments: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setenv("LIGHTPAGE_PRIVATE_NETWORK", "1")  # the test is in one already
    out = folder / "figures.json"
    CliRunner().invoke(command, [*arguments.split(), "--json", str(out)], standalone_mode=False, catch_exceptions=False)
    return json.loads(out.read_text())


def test_no_pair_is_wrong_and_every_loss_has_its_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = measured(pairs.main, "--shots 25 --clean-shots 6 --faults 0.6 --tolerance 0.04", tmp_path, monkeypatch)
    faulty = found["with faults"]
    assert faulty["wrong_pairs"] == faulty["lost_unnamed"] == 0
    assert faulty["faults"] > 5
    lost = sum(sum(reasons.values()) for reasons in faulty["lost"].values())
    assert faulty["taken"] + lost == 25
    assert found["without faults, one shot repeated"]["taken"] >= 5


def test_what_is_plugged_in_again_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = measured(plugs.main, "--times 1", tmp_path, monkeypatch)
    for what in ("camera", "serial line"):
        assert (found[what]["pages_lost"], found[what]["wrong_pairs"]) == (0, 0)
        assert found[what]["back_s_longest"] < 20


def test_bytes_come_after_the_trigger(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = measured(latency.main, "--pages 3", tmp_path, monkeypatch)
    assert found["pages_lost"] + found["pages_unread"] <= 1
    assert 0 < found["without_decoding_s_p50"] < found["trigger_to_bytes_s_p50"] <= found["trigger_to_bytes_s_p99"]
