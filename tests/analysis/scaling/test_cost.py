"""Size that a cluster can reach: the queues against arithmetic, and the command from earlier measurements."""

import json
from pathlib import Path

import pytest

from analysis.scaling import cost
from analysis.scaling.cost import fitted_driver, main
from analysis.scaling.node_figures import DriverFigures, NodeFigures, RunFigures
from lightpage.cli.main import run


def driver(in_flight: int, cpu_s: float) -> DriverFigures:
    return DriverFigures(in_flight=in_flight, cpu_s=cpu_s, main_thread_s=cpu_s, wall_s=0.002)


RUNS = tuple(RunFigures(workers=workers, page_seconds=(0.4, 0.5, 0.6), pages_per_s=workers / 0.5) for workers in (1, 2))
FIGURES = NodeFigures(
    cores=2,
    range_pages=8,
    pages=64,
    measured=RUNS,
    checked=RUNS,
    read_bytes=2.5e6,
    written_bytes=2.5e4,
    record_s=0.004,
    local=(driver(1, 1e-4),),
    ray=(driver(2, 0.001), driver(1002, 0.002)),
)


def test_it_says_how_far_a_cluster_goes_and_what_holds_it_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cost, "PAGES", 10_000)
    nodes = ("--nodes", "1", "--nodes", "4", "--nodes", "40")
    (tmp_path / "node.json").write_text(FIGURES.model_dump_json())
    words = ["--from", str(tmp_path / "node.json"), "--json", str(tmp_path / "cost.json"), *nodes, "--storage", "1e8"]
    assert run(main, [*words, "--picture", str(tmp_path / "cost.png")]) == 0
    found = json.loads((tmp_path / "cost.json").read_text())
    one, four, many = found["kinds"]["bench"]["rates"]
    assert one["pages_per_s"] == pytest.approx(2 / 0.5044, rel=0.03)  # 35 ms a range beside its pages
    assert four["pages_per_s"] == pytest.approx(4 * one["pages_per_s"], rel=0.05)
    assert (four["bound"], many["bound"]) == ("workers", "storage")
    assert many["pages_per_s"] == pytest.approx(1e8 / 2.525e6, rel=0.02)
    full = found["kinds"]["full-size"]
    assert full["rates"][0]["pages_per_s"] == pytest.approx(1 / 3.38, rel=0.03)
    assert full["nodes_that_saturate"]["storage"] == pytest.approx(1e8 / 40.3e6 * 3.325, rel=0.01)
    assert found["checks"][1]["predicted_pages_per_s"] == pytest.approx(2 / 0.5, rel=0.1)
    assert (tmp_path / "cost.png").read_bytes()[:4] == b"\x89PNG"


def test_what_a_range_costs_the_driver_is_a_line_through_what_was_measured() -> None:
    found = fitted_driver(FIGURES.ray, 2)
    assert (found.base_s, found.in_flight_s) == (pytest.approx(0.000998), pytest.approx(1e-6))
    assert found.range_s(500) == pytest.approx(0.001998)
