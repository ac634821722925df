"""Frames and symbols in files of other programs: TIFF, NumPy, MATLAB, HDF5 and pictures, read and written in parts."""
