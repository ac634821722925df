"""Commands that make calibrations and bundles."""
