"""The bench of the cameras counts what arrives, and would see an old frame and a wrong one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from analysis.hardware import cameras
from runtime.cameras.aravis import AravisCamera

pytestmark = pytest.mark.own_network


def test_figures_of_a_short_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cameras, "go_on_inside", lambda module: None)  # the test is in one
    monkeypatch.setattr(cameras, "_FULL", (128, 128))
    monkeypatch.setattr(cameras, "PACKETS_BYTES", (1400, 9000))
    monkeypatch.setattr(cameras, "TOLERANCES_S", (0.02,))
    arguments = f"--changes 3 --pairs 3 --shots 3 --json {tmp_path}/cameras.json"
    CliRunner().invoke(cameras.main, arguments.split(), standalone_mode=False, catch_exceptions=False)
    found: dict[str, Any] = json.loads((tmp_path / "cameras.json").read_text())
    assert found["stale"] == {"changes": 3, "stale": 0, "missing": 0}
    assert {name: one["equal"] for name, one in found["equal"].items()} == dict.fromkeys(cameras.FORMATS, 6)
    assert [one["equal"] for one in found["speed"]] == [3, 3]
    assert [one["packet_bytes"] for one in found["chain"]] == [1400, 9000]
    for one in found["chain"]:
        slower = min(one["cameras_alone_per_s"], one["pairing_alone_per_s"])
        assert one["ratio"] == pytest.approx(one["pairs_per_s"] / slower)
    assert all(0 < one["tick"]["p50_ms"] <= one["tick"]["max_ms"] for one in found["speed"])


def test_an_old_frame_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """A driver that does not arm again hands out what the free run left."""
    arm = AravisCamera.arm
    monkeypatch.setattr(AravisCamera, "arm", lambda self: None if self.opened else arm(self))
    assert cameras.stale_frames(3)["stale"] == 3


def test_a_changed_pixel_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    read = AravisCamera.frame

    def changed(self: AravisCamera, timeout_s: float) -> Any:
        frame = read(self, timeout_s)
        if frame is not None and frame.pixels is not None:
            frame.pixels[-1, -1] ^= 1
        return frame

    monkeypatch.setattr(AravisCamera, "frame", changed)
    assert cameras.equal_frames(2, "Mono12p") == {"frames": 4, "equal": 0, "other": 4, "incomplete": 0}
    monkeypatch.setattr(cameras, "_FULL", (128, 128))
    assert cameras.speed(2, 9000)["equal"] == 0
