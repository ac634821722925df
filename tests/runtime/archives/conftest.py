"""Fixtures of bulk runs."""

from tests.runtime.archives.archive import archive

__all__ = ["archive"]
