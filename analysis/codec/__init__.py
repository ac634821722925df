"""Benchmarks of the page codec: net user bytes on recorded pages, drawn blocks, damaged pages, speed."""
