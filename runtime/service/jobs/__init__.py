"""Recalibrations as jobs, asked for by callers or begun by the service itself."""
