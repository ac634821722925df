"""Tests of the supply chain: what an image is made of, and whether it is."""
