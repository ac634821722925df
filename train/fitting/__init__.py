"""Fitting of a network: loss, validation, precision and the finished weights."""
