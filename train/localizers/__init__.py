"""Localizers: from a recovered field to features that lie where their symbol lies on the page."""

from __future__ import annotations

NAMES = ("coherent", "wave", "oracle")
"""Localizers that can be trained. The oracle knows the simulated truth: a measuring stick, never a product."""
