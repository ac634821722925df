"""Tests of the package `optics`."""
