"""Tests of the whole system, end to end."""
