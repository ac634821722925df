"""Pages as a network takes them."""

from __future__ import annotations

from torch import Tensor

Page = tuple[Tensor, ...]
"""A page, or a batch of pages: inputs of the decoder, and last its true phases [ny, nx]."""
