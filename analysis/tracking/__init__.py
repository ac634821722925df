"""Benchmarks of image tracking: how the image is found, followed and confirmed."""
