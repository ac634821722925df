"""Targets of decoding on a GPU, each beside what was measured and a verdict."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

NOT_MEASURED = "not measured"
Parts = Mapping[str, Any]
RATES = {"standard": (150, 250), "fast": (400, 1000), "accurate": (60, 120)}
"""Pages a second of each preset at the full size: what is aimed at, and what would be better still."""
_USER_MB: dict[str, tuple[float, float]] = {"full size 4x4": (6, 11), "full size 2x2": (12, 30)}
_CODE_MS: dict[str, tuple[float, float]] = {"full size 4x4": (8, 5), "full size 2x2": (22, 14), "bench 4x4": (0.8, 0.4)}
TRAVELS_MB = 50.0
"""Most that a bare machine must be sent."""


@dataclass(frozen=True)
class Target:
    """A target and what was measured.

    Attributes:
        what: with its unit.
        value: value that was measured; None where nothing was.
        target, stretch: what is aimed at, and what would be better still.
        at_least: whether more is better.
    """

    what: str
    value: float | None
    target: float
    stretch: float | None = None
    at_least: bool = True

    @property
    def verdict(self) -> str:
        """Return whether the target is met."""
        if self.value is None or not math.isfinite(self.value):
            return NOT_MEASURED
        reached = [
            aim is not None and (self.value >= aim if self.at_least else self.value <= aim)
            for aim in (self.target, self.stretch)
        ]
        return "stretch met" if reached[1] else "met" if reached[0] else "missed"

    def line(self) -> str:
        """A row of the table."""
        sign, stretch = "≥" if self.at_least else "≤", "" if self.stretch is None else f"{self.stretch:g}"
        value = "" if self.verdict == NOT_MEASURED else f"{self.value:.4g}"
        return f"| {self.what} | {value} | {sign} {self.target:g} | {stretch} | {self.verdict} |"


def targets(parts: Parts, page: str) -> list[Target]:
    """Every target beside what the parts say.

    Args:
        parts: results, by name.
        page: kind of page that was decoded, as `analysis.codec.speed.PAGES` names it.
    """
    rates = {preset: _best(parts, preset, "pages_per_s") for preset in RATES}
    code, through = parts.get("page code", {}), parts.get("service", {})
    found = [Target(f"`{preset}`, pages/s to p", rates[preset], *RATES[preset]) for preset in RATES]
    found += [
        Target(f"`{preset}`, AIR off today's, bit", _air_off(parts, preset), 0.01, None, False) for preset in RATES
    ]
    for name, aims in _USER_MB.items():
        rate = rates["standard"] if name == page and name in code else None
        value = None if rate is None else rate * code[name]["user_bytes"] / 1e6
        found.append(Target(f"user MB/s, `standard`, {name}: pages/s times bytes of a page", value, *aims))
    alone = parts.get("standard, 1 a batch", {}).get("alone_ms")
    found.append(Target("one page alone, `standard`, ms", alone, 30, 12, False))
    found.append(Target("service by shared memory over in-process", through.get("over_in_process"), 0.8, 0.95))
    found.append(Target("stream of gRPC chunks over one that is not decoded", through.get("stream_over_bare"), 0.9))
    bulk, inside = parts.get("bulk", {}).get("pages_per_s"), through.get("in_process_pages_per_s")
    found.append(Target("`bulk decode` over in-process", bulk / inside if bulk and inside else None, 0.7))
    for name, aims in _CODE_MS.items():
        found.append(Target(f"page code, ms of one core, {name}", code.get(name, {}).get("compiled_ms"), *aims, False))
    size = parts.get("bundle", {}).get("bytes")
    found.append(Target("bundle with both forms, MB", None if size is None else size / 1e6, 60, None, False))
    memory = [part["memory_gb"] for part in parts.values() if isinstance(part, Mapping) and "memory_gb" in part]
    found.append(Target("GPU memory at the largest batch, GB", max(memory, default=None), 24, None, False))
    travels = parts.get("travels", {}).get("megabytes")
    found.append(Target("sent to a bare machine, MB", travels, TRAVELS_MB, None, False))
    return found


def table(parts: Parts, page: str) -> list[str]:
    """Return the parts for people: targets and verdicts, then rates beside floors, and where time goes."""
    told = ["| what | measured | target | stretch | verdict |", "|---" * 5 + "|"]
    told += [target.line() for target in targets(parts, page)]
    told += [
        "",
        "| preset | a batch | pages/s | graph, ms | batch alone, ms | floors, ms | AIR, today's |",
        "|---" * 7 + "|",
    ]
    groups = []
    for preset in RATES:
        least, present = parts.get(f"{preset}, floor"), parts.get(f"{preset}, present")
        for name, part in _batches(parts, preset).items():
            if not least or not present:
                continue
            floors = ", ".join(f"{least[key]:.2f}" for key in ("bytes_ms", "flops_ms", "bus_ms") if key in least)
            air = f"{np.mean(part['air']):.4f}, {np.mean(present['air'][: len(part['air'])]):.4f}"
            told.append(
                f"| {preset} | {part['pages']} | {part['pages_per_s']:.1f} | {part['graph_ms_a_page']:.2f} | "
                f"{part.get('alone_ms', math.nan):.1f} | {floors} | {air} |"
            )
            split = ", ".join(f"{group} {ms:.2f}" for group, ms in part.get("groups_ms_a_page", {}).items())
            if split:
                groups.append(f"{name}, {part['kernels']} kernels, ms a page: {split}")
    return [*told, *groups]


def _batches(parts: Parts, preset: str) -> dict[str, Any]:
    """Parts of a preset's batches, by name."""
    return {name: part for name, part in parts.items() if name.startswith(f"{preset}, ") and name.endswith(" a batch")}


def _best(parts: Parts, preset: str, key: str) -> float | None:
    return max((part[key] for part in _batches(parts, preset).values()), default=None)


def _air_off(parts: Parts, preset: str) -> float | None:
    """The largest distance of a page's AIR from the single form's."""
    present = parts.get(f"{preset}, present", {"air": []})["air"]
    off = [abs(a - b) for part in _batches(parts, preset).values() for a, b in zip(part["air"], present, strict=False)]
    return max(off, default=None)
