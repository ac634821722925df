"""Precision of training: the arithmetic that is chosen by the machine where nobody chooses it."""

from __future__ import annotations

import torch

AUTO = "auto"
PRECISIONS = (AUTO, "bf16-mixed", "16-mixed", "32-true")


def lightning_precision(precision: str, device: torch.device) -> str:
    """Lightning's name of a precision of `PRECISIONS` on a device.

    Where a processor has no bfloat16, emulating it takes longer than computing with all 32 bits.
    """
    if precision != AUTO:
        return precision
    if device.type == "cuda":
        return "bf16-mixed"
    can = torch.cpu.get_capabilities()
    return "bf16-mixed" if can.get("avx512_bf16") or can.get("amx_bf16") or can.get("arm_bf16") else "32-true"
