"""Tests of the package `train.published`."""
