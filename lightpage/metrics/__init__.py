"""Metrics of a decoded page: the information that it carries, and the calibration of its confidences."""
