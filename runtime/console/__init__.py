"""The console: the service's web page, its HTTP server, and metrics for Prometheus.

This room imports `service`, `client` and, for the errors of a recalibration, `recalibration`.
"""
