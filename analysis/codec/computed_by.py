"""Chooses the arithmetic of the page code for a while."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

from lightpage.codec.compiled.choice import VARIABLE


@contextmanager
def computed_by(name: str) -> Iterator[None]:
    """Inside, the page code is computed by numpy or by the compiled arithmetic."""
    before = os.environ.get(VARIABLE)
    os.environ[VARIABLE] = name
    try:
        yield
    finally:
        os.environ.pop(VARIABLE)
        if before is not None:
            os.environ[VARIABLE] = before
