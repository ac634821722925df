"""A drifted device's geometry, fitted again."""
