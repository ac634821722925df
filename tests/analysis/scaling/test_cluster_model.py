"""The queues of a cluster against what arithmetic says where one part alone is the limit."""

from __future__ import annotations

from dataclasses import replace

import pytest

from analysis.scaling.cluster_model import Cluster, Driver, Work, nodes_that_saturate, simulated

WORK = Work(page_seconds=(0.5,), read_bytes=1e6, written_bytes=1e4, range_s=0.02, range_pages=8)
IDLE = Driver(base_s=1e-6, in_flight_s=0.0, ahead=2)
WIDE = Cluster(nodes=4, workers=2, storage_bytes_per_s=1e15, link_bytes_per_s=1e15)


def test_workers_that_wait_for_nothing_read_as_fast_as_they_decode() -> None:
    rate = simulated(WIDE, WORK, IDLE)
    assert rate.pages_per_s == pytest.approx(8 / (0.5 + 0.02 / 8), rel=1e-3)
    assert (rate.efficiency, rate.bound, rate.lost_ranges) == (pytest.approx(1, rel=1e-3), "workers", 0)


def test_a_storage_that_is_slower_than_the_workers_sets_the_rate() -> None:
    rate = simulated(replace(WIDE, storage_bytes_per_s=5e6), WORK, IDLE, ranges_per_worker=40)
    assert rate.pages_per_s == pytest.approx(5e6 / 1.01e6, rel=0.02)
    assert rate.bound == "storage"


def test_a_driver_that_is_slower_than_the_workers_sets_the_rate() -> None:
    driver = Driver(base_s=0.5, in_flight_s=0.05, ahead=2)
    rate = simulated(WIDE, WORK, driver, ranges_per_worker=40)
    assert rate.pages_per_s == pytest.approx(8 / driver.range_s(8), rel=0.02)
    assert rate.bound == "driver"


@pytest.mark.parametrize("part", ["driver", "storage"])
def test_the_nodes_that_saturate_a_part_by_arithmetic_do_so_in_the_queues(part: str) -> None:
    driver = Driver(base_s=0.02, in_flight_s=0.001, ahead=2) if part == "driver" else IDLE
    cluster = replace(WIDE, storage_bytes_per_s=1e15 if part == "driver" else 40e6)
    nodes = nodes_that_saturate(cluster, WORK, driver)[part]
    asked = nodes * cluster.workers / WORK.mean_s  # pages a second
    busy = asked / WORK.range_pages * (driver.base_s + driver.in_flight_s * driver.ahead * nodes * cluster.workers)
    assert (busy if part == "driver" else asked * 1.01e6 / 40e6) == pytest.approx(1)
    below, above = (simulated(replace(cluster, nodes=round(share * nodes)), WORK, driver) for share in (0.5, 2.0))
    assert (below.bound, above.bound) == ("workers", part)
    assert below.efficiency > 0.95
    assert getattr(above, part) == pytest.approx(1, abs=0.05)
