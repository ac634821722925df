"""Fixtures of bulk runs."""

from tests.runtime.scaling.archive import archive

__all__ = ["archive"]
