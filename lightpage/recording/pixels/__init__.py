"""Pixels of a camera that do not count light as the others do."""
