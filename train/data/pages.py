"""Pages as a network takes them."""

from __future__ import annotations

from torch import Tensor

Page = tuple[Tensor, ...]
"""One page, or a batch of them: what the decoder is told, and last its true phases [ny, nx]."""
