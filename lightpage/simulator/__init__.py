"""A simulated device that records pages."""
