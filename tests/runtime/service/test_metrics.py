"""The operator sees what the service does."""

from __future__ import annotations

import urllib.request

from runtime.decoding.decoder import Decoder
from runtime.service.metrics import MetricsServer, ServiceMetrics
from tests.runtime import toy


def test_the_figures_are_shown_on_loopback_and_the_port_is_given_back(decoder: Decoder) -> None:
    metrics = ServiceMetrics()
    page = decoder.decode(toy.ToyDevice().page(toy.symbols_of(16, 1)[0], 16, 0.5), 16)
    metrics.page(page, "toy-1")
    metrics.in_service("toy-1")
    metrics.in_service("toy-2")
    server = MetricsServer.start(metrics, 0)
    with urllib.request.urlopen(f"http://127.0.0.1:{server.port}/metrics", timeout=5) as reply:
        text = reply.read().decode()
    assert 'lightpage_pages_total{model_version="toy-1"} 1.0' in text
    assert 'lightpage_model_info{version="toy-2"} 1.0' in text
    assert 'version="toy-1"} 1.0' not in text.replace("model_version", "")
    assert "lightpage_decode_seconds_count 1.0" in text
    server.close()
    again = MetricsServer.start(metrics, server.port)
    again.close()
