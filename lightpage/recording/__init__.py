"""Frames and pages in HDF5."""
