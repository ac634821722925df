"""Goodness of fit of a calibration: a verdict, maps of unexplained light, and its likeliest cause."""
