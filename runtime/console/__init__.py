"""The console: the service's web page, its HTTP server, and metrics for Prometheus.

This room imports `service`, `client`, and `recalibration` for its least number of pages.
"""
