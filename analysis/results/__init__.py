"""Figures of the benchmarks, one JSON file for each measurement, and docs/results.md made from them."""
