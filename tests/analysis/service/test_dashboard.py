"""The picture of the dashboard shows its panels: whatever has data is drawn, and whatever has none is named."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from analysis.service.dashboard import DASHBOARD, Drawing, formatted

START, END = 1_000_000.0, 1_000_060.0


class Answers:
    """Answers as Prometheus does, of the store's trouble with nothing."""

    def over(self, expression: str, start: float, end: float, step_s: float) -> list[dict[str, Any]]:
        assert "$" not in expression
        if "store_trouble" in expression or "flight" in expression:
            return []
        moments = np.arange(start, end, step_s)
        named = {"stage": "queue", "code": "OK", "version": "bench-9"}
        return [{"metric": named, "values": [(at, str(number % 7)) for number, at in enumerate(moments)]}]


def test_every_panel_is_drawn_and_empty_ones_are_named(tmp_path: Path) -> None:
    whole = json.loads(DASHBOARD.read_text())
    out = tmp_path / "dashboard.png"
    assert Drawing(Answers(), START, END).draw(whole, out) == ["Store and flight recorder"]  # type: ignore[arg-type]
    picture = np.asarray(Image.open(out).convert("RGB")).astype(int)
    height, width, _ = picture.shape
    rows = max(panel["gridPos"]["y"] + panel["gridPos"]["h"] for panel in whole["panels"])
    for panel in whole["panels"]:
        if panel["type"] == "row":
            continue
        at = panel["gridPos"]
        top, left = int(height * (at["y"] + 1) / rows), int(width * at["x"] / 24) + 5
        part = picture[top : int(height * (at["y"] + at["h"]) / rows), left : int(width * (at["x"] + at["w"]) / 24) - 5]
        colourful = (part.max(axis=2) - part.min(axis=2) > 60).any()
        assert colourful != (panel["title"] == "Store and flight recorder"), panel["title"]


@pytest.mark.parametrize(
    ("unit", "value", "text"),
    [
        ("s", 0.0123, "12.3 ms"),
        ("s", 90.0, "1.5 min"),
        ("s", 7200.0, "2 h"),
        ("bytes", 3 << 20, "3 MiB"),
        ("Bps", 512.0, "512 B/s"),
        ("percentunit", 0.125, "12.5%"),
        ("ops", 1.5, "1.5/s"),
        ("none", float("nan"), "-"),
    ],
)
def test_values_are_told_in_their_unit(unit: str, value: float, text: str) -> None:
    assert formatted(unit)(value, None) == text
