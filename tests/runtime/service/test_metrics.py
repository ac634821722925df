"""The operator sees what the service does."""

from __future__ import annotations

from prometheus_client import generate_latest

from runtime.decoding.decoder import Decoder
from runtime.service.metrics import VERSIONS, ServiceMetrics
from tests.runtime import toy


def test_the_figures_are_in_the_format_of_prometheus(decoder: Decoder) -> None:
    metrics = ServiceMetrics()
    page = decoder.decode(toy.ToyDevice().page(toy.symbols_of(16, 1)[0], 16, 0.5), 16)
    metrics.in_service("toy-1")
    metrics.page(page, "toy-1")
    metrics.in_service("toy-2")
    text = generate_latest(metrics.registry).decode()
    assert 'lightpage_pages_total{model_version="toy-1"} 1.0' in text
    assert 'lightpage_model_info{version="toy-2"} 1.0' in text
    assert 'version="toy-1"} 1.0' not in text.replace("model_version", "")
    assert "lightpage_decode_seconds_count 1.0" in text


def test_pages_are_told_apart_by_the_newest_models_only(decoder: Decoder) -> None:
    metrics = ServiceMetrics()
    page = decoder.decode(toy.ToyDevice().page(toy.symbols_of(16, 1)[0], 16, 0.5), 16)
    for number in range(3 * VERSIONS):
        metrics.in_service(f"toy-{number}")
        metrics.pages.labels(f"toy-{number}").inc()
        metrics.in_service("toy-0")
    metrics.page(page, "toy-1")  # it was decoded while its model was removed
    told = {sample.labels["model_version"] for family in metrics.pages.collect() for sample in family.samples}
    assert len(told) <= VERSIONS
    assert {"toy-0", f"toy-{3 * VERSIONS - 1}"} <= told


def test_the_process_is_told_of() -> None:
    text = generate_latest(ServiceMetrics().registry).decode()
    for name in ("process_resident_memory_bytes", "process_open_fds", "python_gc_collections_total", "python_info"):
        assert f"\n{name}" in text
