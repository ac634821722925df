"""Calibration: a device's geometry fitted to a few known pages."""
