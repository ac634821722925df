"""Calibration by waves: the wave model of a device, fitted to both raw frames of a known page."""
