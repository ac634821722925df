"""Figures of the benchmarks, one JSON file for each measurement, and docs/results/index.md made from them."""
