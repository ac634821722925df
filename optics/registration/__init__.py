"""Measuring a device against known pages and fitting its geometry with a twin."""
