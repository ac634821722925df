"""Chooses the arithmetic of the page code for a while."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

from lightpage.codec.compiled.choice import VARIABLE


@contextmanager
def computed_by(name: str) -> Iterator[None]:
    """Compute the page code by numpy or by the compiled arithmetic in the `with` statement."""
    before = os.environ.get(VARIABLE)
    os.environ[VARIABLE] = name
    try:
        yield
    finally:
        os.environ.pop(VARIABLE)
        if before is not None:
            os.environ[VARIABLE] = before
