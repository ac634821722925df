"""Tests of the package `lightpage`."""
