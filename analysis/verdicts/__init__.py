"""Verdicts of calibrations beside what is read afterwards, and the causes that they name."""
