"""The operator sees what the service does."""

from __future__ import annotations

import pytest
from prometheus_client import generate_latest

from runtime.decoding.decoder import Decoder
from runtime.decoding.page import DecodedPage
from runtime.service.metrics import VERSIONS, ServiceMetrics
from tests.runtime import toy


@pytest.fixture
def page(decoder: Decoder) -> DecodedPage:
    return decoder.decode(toy.ToyDevice().page(toy.symbols_of(16, 1)[0], 16, 0.5), 16)


def test_the_figures_are_in_the_format_of_prometheus(page: DecodedPage) -> None:
    metrics = ServiceMetrics()
    metrics.in_service("toy-1")
    metrics.page(page, "toy-1")
    metrics.in_service("toy-2")
    text = generate_latest(metrics.registry).decode()
    assert 'lightpage_pages_total{model_version="toy-1"} 1.0' in text
    assert 'lightpage_model_info{version="toy-2"} 1.0' in text
    assert 'version="toy-1"} 1.0' not in text.replace("model_version", "")
    assert "lightpage_decode_seconds_count 1.0" in text
    for name in ("process_resident_memory_bytes", "process_open_fds", "python_gc_collections_total", "python_info"):
        assert f"\n{name}" in text


def test_pages_are_told_apart_by_the_newest_models_only(page: DecodedPage) -> None:
    metrics = ServiceMetrics()
    for number in range(3 * VERSIONS):
        metrics.in_service(f"toy-{number}")
        metrics.pages.labels(f"toy-{number}").inc()
        metrics.in_service("toy-0")
    metrics.page(page, "toy-1")  # it was decoded while its model was removed
    told = {sample.labels["model_version"] for family in metrics.pages.collect() for sample in family.samples}
    assert len(told) <= VERSIONS
    assert {"toy-0", f"toy-{3 * VERSIONS - 1}"} <= told
