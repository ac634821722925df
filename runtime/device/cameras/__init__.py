"""Cameras: what one is, and the drivers."""
