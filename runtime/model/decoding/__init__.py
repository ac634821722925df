"""Decoding of frame pairs into symbols, page after page."""
