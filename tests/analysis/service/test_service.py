"""Benchmarks of the service: what of them is cheap to check."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from analysis.service import dashboard, outgoing
from analysis.service.other_servers.environments import NAMES, requirements
from analysis.service.other_servers.figures import Comparison, Figure
from lightpage.errors import LightpageError

ROOT = Path(__file__).resolve().parents[3]
TRACE = """\
71 1764100000.100000 connect(3, {sa_family=AF_UNIX, sun_path="/var/run/nscd/socket"}, 110) = -1 ENOENT (No such file)
71 1764100000.200000 connect(3, {sa_family=AF_INET, sin_port=htons(50052), sin_addr=inet_addr("127.0.0.1")}, 16) = 0
73 1764100001.100000 connect(5, {sa_family=AF_INET6, sin6_port=htons(443), sin6_flowinfo=htonl(0), \
inet_pton(AF_INET6, "2001:db8::7", &sin6_addr), sin6_scope_id=0}, 28 <unfinished ...>
74 1764100001.300000 sendmmsg(6, [{msg_hdr={msg_name={sa_family=AF_INET, sin_port=htons(9), \
sin_addr=inet_addr("192.0.2.9")}, msg_namelen=16}, msg_len=3}], 1, 0) = 1
74 1764100001.400000 connect(6, {sa_family=AF_INET, sin_port=htons(53), sin_addr=inet_addr("127.0.0.53")}, 16) = 0
"""


def test_addresses_of_other_machines_and_name_servers_are_outgoing(tmp_path: Path) -> None:
    (trace := tmp_path / "trace.txt").write_text(TRACE)
    found = [(call.call, call.address, call.port) for call in outgoing.calls(trace) if call.outgoing]
    assert found == [("connect", "2001:db8::7", 443), ("sendmmsg", "192.0.2.9", 9), ("connect", "127.0.0.53", 53)]
    trace.write_text("71 1764100000.100000 io_uring_setup(8, {flags=0}) = 4\n")
    with pytest.raises(LightpageError):
        list(outgoing.calls(trace))


class Answers:
    """Answers as Prometheus does, of the store's trouble with nothing."""

    def over(self, expression: str, start: float, end: float, step_s: float) -> list[dict[str, Any]]:
        if "store_trouble" in expression or "flight" in expression:
            return []
        named = {"stage": "queue", "code": "OK", "version": "bench-9"}
        values = [(at, str(number % 7)) for number, at in enumerate(np.arange(start, end, step_s))]
        return [{"metric": named, "values": values}]


def test_every_panel_of_the_dashboard_is_drawn_and_empty_ones_are_named(tmp_path: Path) -> None:
    out, drawing = tmp_path / "dashboard.png", dashboard.Drawing(Answers(), 1_000_000.0, 1_000_060.0)  # type: ignore[arg-type]
    assert drawing.draw(json.loads(dashboard.DASHBOARD.read_text()), out) == ["Store and flight recorder"]
    assert Image.open(out).width > 500
    shown = [
        dashboard.formatted(unit)(value, None) for unit, value in (("s", 0.0123), ("bytes", 3 << 20), ("ops", 1.5))
    ]
    assert shown == ["12.3 ms", "3 MiB", "1.5/s"]


# ---- other servers --------------------------------------------------------------------------------------------------


def test_a_server_is_better_only_by_more_than_the_larger_spread() -> None:
    figure = Figure.of([float(value) for value in range(101)])
    assert (figure.p10, figure.p50, figure.p90) == pytest.approx((10, 50, 90))
    own = Figure(9, 10, 11)
    assert Comparison.of(own, Figure(14, 15, 16)) == Comparison(difference=5, spread=2)
    assert Comparison.of(own, Figure(10, 15, 20)).missed_by == 5
    assert Comparison.of(own, Figure(4, 5, 6), more_is_better=True).missed_by == -3


def test_all_environments_are_pinned_and_have_the_onnx_runtime_of_the_service() -> None:
    own = dict(re.findall(r"^([\w.-]+)==(\S+)$", (ROOT / "constraints.txt").read_text("utf-8"), re.M))
    for name in NAMES:
        pinned = dict(line.split("==") for line in requirements(name).split())
        assert name in pinned
        assert all(pinned[key] == own[key] for key in ("onnxruntime", "grpcio", "numpy"))
