"""The dashboard of deploy/grafana, drawn from what a Prometheus has scraped."""
