"""Calibrations from nominal, of drawn devices and of what cannot be right."""
