"""Errors that only a running service has, beside those of `optics/errors.py`."""

from __future__ import annotations

from optics.errors import BusyError, LightpageError


class SourceError(LightpageError):
    """The service's own source or recordings are missing, damaged or dark: nothing that the caller sent is wrong."""


class StoppingError(LightpageError):
    """The service is being stopped and drops the work."""


class SlotsTakenError(BusyError):
    """The service does as much as it may at once, and did so until the caller's time was up."""
